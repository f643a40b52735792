from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from deepdetect.geometry.camera import Camera, PosedView
from deepdetect.geometry.point_cloud import PointCloud
from deepdetect.io.html_viewer import (
    page_points,
    write_html_page,
)
from deepdetect.io.point_cloud import save_point_cloud


class Page(HTMLParser):
    """The texts of a page's scripts, its tags, and the addresses in their attributes."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.scripts: dict[str, str] = {}
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.texts: list[str] = []
        self._inside: str | None = None
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        values = dict(attributes)
        self.tags.append(tag)
        self.addresses += [values[name] for name in ("src", "href", "action") if name in values]
        self._inside = (values.get("id") or "code") if tag == "script" else None

    def handle_data(self, data: str) -> None:
        if self._inside:
            self.scripts[self._inside] = self.scripts.get(self._inside, "") + data
        elif data.strip():
            self.texts.append(data.strip())

    def handle_endtag(self, tag: str) -> None:
        self._inside = None


def saved(cloud: PointCloud, path: Path, notes: dict | None = None) -> Page:
    save_point_cloud(cloud, path, notes)
    return Page(path.read_text("utf-8"))


def stored_points(page: Page) -> tuple[np.ndarray, np.ndarray, dict]:
    cloud = json.loads(page.scripts["cloud"])
    levels = np.frombuffer(base64.b64decode(page.scripts["positions"]), "<u2").reshape(-1, 3)
    colors = np.frombuffer(base64.b64decode(page.scripts["colors"]), np.uint8).reshape(-1, 3)
    return levels * np.array(cloud["step"]) + cloud["offset"], colors, cloud


def test_the_page_holds_the_points_to_half_a_step(cones: PointCloud, tmp_path: Path) -> None:
    page = saved(cones, tmp_path / "cones.html")
    points, colors, cloud = stored_points(page)
    left_out = len(cones) - cloud["count"]
    assert len(points) == len(colors) == cloud["count"]
    assert 0 < left_out < 0.001 * len(cones)
    # The points are in their order, without those that are far away.
    box = np.percentile(cones.points, [1, 99], axis=0)
    margin = box[1] - box[0]
    near = ((cones.points >= box[0] - margin) & (cones.points <= box[1] + margin)).all(1)
    assert near.sum() == cloud["count"]
    error = np.abs(points - cones.points[near])
    assert (error <= np.array(cloud["step"]) * 0.5001).all()
    np.testing.assert_array_equal(colors, cones.colors[near])
    assert f"{cloud['count']:,}" in page.texts
    assert f"{left_out:,}" in page.texts
    assert (tmp_path / "cones.html").stat().st_size < 12.1 * len(cones) + 20_000


def test_nothing_is_fetched(small: PointCloud, tmp_path: Path) -> None:
    page = saved(small, tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text("utf-8")
    assert not [address for address in page.addresses if not address.startswith("data:")]
    assert "default-src 'none'" in text  # the browser refuses what we may have missed
    assert not re.findall(r"https?://|//cdn|@import|url\(|fetch\(|XMLHttp|import\(", text)


def test_notes_are_shown_and_escaped(small: PointCloud, tmp_path: Path) -> None:
    evil = "</script><script>alert(1)</script>"
    notes = {"title": f"a & b {evil}", "scene": evil, "<b>": "{{positions}}", "points": 49979}
    page = saved(small, tmp_path / "page.html", notes)
    plain = saved(small, tmp_path / "plain.html")
    assert page.tags.count("script") == plain.tags.count("script") == 4
    assert "b" not in page.tags
    assert evil in page.texts
    assert "{{positions}}" in page.texts
    assert "49,979" in page.texts
    assert f"a & b {evil}" in page.texts


def run_node(page: Page, code: str) -> dict:
    """Run code after the page's own script, with the browser's parts that it names at start."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("needs node, to run the page's script")
    script = (
        "const requestAnimationFrame = () => {};\n"
        + page.scripts["code"]
        + "\nconst cloud = JSON.parse(process.argv[1]);\nconsole.log(JSON.stringify((() => {"
        + code
        + "})()));"
    )
    done = subprocess.run(
        [node, "-e", script, page.scripts["cloud"]], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("aspect", [0.5, 1.0, 2.0])
def test_the_first_view_shows_the_cloud_upright(
    cones: PointCloud, aspect: float, tmp_path: Path
) -> None:
    page = saved(cones, tmp_path / "cones.html")
    matrix = run_node(page, f"return [...clipMatrix(cloud, firstView(cloud), {aspect})];")
    stored = page_points(cones)
    homogeneous = np.column_stack([stored.levels, np.ones(len(stored.levels))])
    clip = homogeneous @ np.reshape(matrix, (4, 4))  # column by column
    screen = clip[:, :3] / clip[:, 3:]
    inside = (np.abs(screen) < 1).all(1)
    assert inside.mean() > 0.9
    # What is up in the photograph is up on the screen, and right is right; it is seen from where
    # the photograph was taken.
    picture = cones.points[:, :2] / cones.points[:, 2:]
    near = (cones.points[:, 2] <= cones.points[:, 2].max()) & _kept(cones)
    assert np.corrcoef(picture[near, 0], screen[:, 0])[0, 1] > 0.9999
    assert np.corrcoef(picture[near, 1], screen[:, 1])[0, 1] < -0.9999


def _kept(cloud: PointCloud) -> np.ndarray:
    stored = page_points(cloud)
    high = stored.offset + 65535 * stored.step
    slack = stored.step / 2
    return ((cloud.points >= stored.offset - slack) & (cloud.points <= high + slack)).all(1)


def test_the_matrix_is_that_of_a_camera_around_the_target(
    small: PointCloud, tmp_path: Path
) -> None:
    page = saved(small, tmp_path / "page.html")
    view = "{ azimuth: 0.4, elevation: 0.7, distance: 500, target: [5, 6, 800] }"
    matrix = np.reshape(run_node(page, f"return [...clipMatrix(cloud, {view}, 1)];"), (4, 4))
    cloud = json.loads(page.scripts["cloud"])
    (ca, ce), (sa, se) = np.cos([0.4, 0.7]), np.sin([0.4, 0.7])
    axes = np.array([[ca, 0, sa], [se * sa, ce, -se * ca], [-ce * sa, se, ce * ca]])
    seen = (np.array([30.0, -40.0, 900.0]) - [5, 6, 800]) @ axes.T + [0, 0, 500]
    level = (np.array([30.0, -40.0, 900.0]) - cloud["offset"]) / cloud["step"]
    clip = [*level, 1] @ matrix
    zoom = 1 / cloud["slope"]
    np.testing.assert_allclose(clip[3], seen[2], rtol=1e-4)
    np.testing.assert_allclose(
        clip[:2] / clip[3], seen[:2] / seen[2] * [zoom, -zoom], rtol=1e-3, atol=1e-4
    )


def view_cameras() -> list[PosedView]:
    camera = Camera((640, 480), 500.0)
    return [
        PosedView(f"{x:g}", camera, np.eye(3), np.array([-x, 0.0, 0.0])) for x in (0.0, 1.0, 2.0)
    ]


def test_cameras_are_lines_of_the_page(cones: PointCloud, tmp_path: Path) -> None:
    path = tmp_path / "cones.html"
    write_html_page(cones, path, {}, view_cameras())
    page = Page(path.read_text("utf-8"))
    _, _, cloud = stored_points(page)
    lines = np.array(cloud["lines"]).reshape(-1, 2, 3)
    assert len(lines) == 3 * 8 + 2  # a pyramid each, and the path
    np.testing.assert_allclose(lines[-2:, :, 0], [[0, 1], [1, 2]])
    # The first pyramid is that of what the camera sees: a corner's ray, at one depth.
    corner = lines[0, 1]
    expected = (np.array([-0.5, -0.5]) - (319.5, 239.5)) / 500
    np.testing.assert_allclose(corner[:2] / corner[2], expected)
    assert cloud["reach"] >= np.linalg.norm(lines - cloud["centre"], axis=2).max() - 1e-4
    assert saved(cones, tmp_path / "plain.html").scripts["cloud"].count('"lines": []') == 1


def test_a_page_with_cameras_opens_where_all_of_them_are_seen(
    cones: PointCloud, tmp_path: Path
) -> None:
    spacing = 0.2 * float(np.median(cones.points[:, 2]))
    camera = Camera((640, 480), 500.0)
    cameras = [
        PosedView(f"{x:g}", camera, np.eye(3), np.array([-x * spacing, 0.0, 0.0])) for x in range(4)
    ]
    path = tmp_path / "cones.html"
    write_html_page(cones, path, {}, cameras)
    page = Page(path.read_text("utf-8"))
    points, _, cloud = stored_points(page)
    for aspect in (0.6, 1.0, 1.8):
        code = f"return [...clipMatrix(cloud, firstView(cloud), {aspect})];"
        matrix = np.reshape(run_node(page, code), (4, 4))

        def screen(world: np.ndarray, matrix: np.ndarray = matrix) -> np.ndarray:
            levels = (world - cloud["offset"]) / cloud["step"]
            clip = np.column_stack([levels, np.ones(len(levels))]) @ matrix
            assert (clip[:, 3] > 0).all()
            return clip[:, :3] / clip[:, 3:]

        lines = screen(np.array(cloud["lines"]).reshape(-1, 3))
        assert (np.abs(lines) < 1).all()
        seen = screen(points)
        assert (np.abs(seen) < 1).all(axis=1).mean() > 0.95
        # It is as near as it can be.
        if aspect == 1.0:
            both = np.concatenate([lines, seen])[:, :2]
            assert np.percentile(np.abs(both), 99.9, axis=0).max() > 0.8
    again = run_node(page, "const v = firstView(cloud); v.azimuth = 9; return firstView(cloud);")
    assert again["azimuth"] == pytest.approx(0.4)
    assert json.loads(saved(cones, tmp_path / "plain.html").scripts["cloud"])["view"] is None
