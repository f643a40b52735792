"""The stereo benchmark on a corner of cones, beside the truth and beside known answers."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from deepdetect import DeepDetect, OptionError
from deepdetect.datasets.middlebury import load_calibrated_pair
from deepdetect.datasets.types import CalibratedStereoPair
from deepdetect.detector.heatmap import HeatmapOptions
from deepdetect.evaluation.cache import StageCache
from deepdetect.evaluation.protocols import BenchmarkOptions
from deepdetect.evaluation.protocols.middlebury import middlebury_sections, middlebury_steps, voxels
from deepdetect.evaluation.protocols.published_pipeline import published_detector
from deepdetect.evaluation.protocols.published_stereo import SETTINGS, published_points
from deepdetect.evaluation.protocols.stereo_pipelines import STAGES, pipelines, sgbm
from deepdetect.evaluation.report import Section
from deepdetect.evaluation.workspace import Workspace
from deepdetect.geometry.camera import Calibration, Camera

pytest.importorskip("torch", reason="the published pipeline runs in torch")

TOP, LEFT, HEIGHT, WIDTH = 120, 100, 160, 260


@pytest.fixture(scope="module")
def data(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A corner of cones, and the same without its truth."""
    root = tmp_path_factory.mktemp("stereo")
    source = shared / "data" / "middlebury" / "cones"
    calibration = json.loads((source / "calib.json").read_text())
    for name in ("cones", "nothing-known"):
        folder = root / "middlebury" / name
        folder.mkdir(parents=True)
        known = dict(calibration, width=WIDTH, height=HEIGHT)
        if name != "cones":
            del known["ground_truth"]
        (folder / "calib.json").write_text(json.dumps(known))
        for file in ("left.png", "right.png", "disparity.png"):
            with Image.open(source / file) as image:
                image.crop((LEFT, TOP, LEFT + WIDTH, TOP + HEIGHT)).save(folder / file)
    return root


@pytest.fixture(scope="module")
def options() -> BenchmarkOptions:
    return BenchmarkOptions(DeepDetect(), ("paper",), ("sift", "sift-low"))


@pytest.fixture(scope="module")
def section(
    data: Path, options: BenchmarkOptions, tmp_path_factory: pytest.TempPathFactory
) -> Section:
    done: list[int] = []
    cache = StageCache(tmp_path_factory.mktemp("cache"))
    workspace = Workspace(data, cache, lambda steps, text: done.append(steps))
    (found,) = middlebury_sections(workspace, options)
    assert sum(done) == middlebury_steps(workspace, options) > 0
    made = cache.made
    (again,) = middlebury_sections(workspace, options)
    assert cache.made == made
    assert again.tables == found.tables
    assert [note for note in workspace.left_out if "nothing-known" in note]
    return found


def rows(section: Section, key: str) -> dict[str, dict[str, object]]:
    (table,) = [table for table in section.tables if table.key == key]
    titles = [column.title for column in table.columns]
    return {str(row[0]): dict(zip(titles, row, strict=True)) for row in table.rows}


def test_ours_is_exact_and_the_controls_are_there(section: Section) -> None:
    found = rows(section, "middlebury_cones")
    ours = found["ours, weights dense"]
    assert ours["points"] > 8_000
    assert ours["within 1 px"] > 0.97
    assert ours["within 2 px"] > 0.985
    assert ours["of them filled"] == 0
    every = found["every pixel, --density 1"]
    assert every["completeness at 1 px"] > found["control: every pixel"]["completeness at 1 px"]
    assert every["of them filled"] > 0
    assert found["control: every pixel"]["points"] > ours["points"]
    random = found["control: as many random pixels as ours"]
    assert random["points"] == pytest.approx(ours["points"], rel=0.3)
    assert found["OpenCV's SGBM"]["completeness at 1 px"] > 0.6
    assert found["SIFT, low settings"]["points"] > found["SIFT"]["points"]
    published = found["published pipeline, weights dense"]
    assert published["points in the paper"] == 49_979
    assert ours["times faster than published"] == pytest.approx(
        published["seconds"] / ours["seconds"]
    )


def test_every_pipeline_tells_what_its_stages_took(section: Section) -> None:
    for name, row in rows(section, "middlebury_cones").items():
        seconds = [row[f"{stage}, s"] for stage in STAGES]
        known = [value for value in seconds if value is not None]
        assert known, name
        assert row["seconds"] == pytest.approx(sum(known))
        assert (row["matching, s"] or 0) > 0, name


def test_without_a_truth_nothing_is_judged(section: Section) -> None:
    judged, blank = (rows(section, f"middlebury_{s}") for s in ("cones", "nothing-known"))
    for name, row in blank.items():
        assert row["within 1 px"] is None
        assert row["F-score"] is None
        if name.startswith(("ours", "every", "control: every", "OpenCV")):
            assert row["points"] == judged[name]["points"]


def test_figure_8_is_a_picture_with_counts(section: Section) -> None:
    figures = {figure.key: figure for figure in section.figures}
    assert list(figures) == ["figure8_cones", "figure8_nothing-known"]
    figure = figures["figure8_cones"]
    points = rows(section, "middlebury_cones")["ours, weights dense"]["points"]
    assert f"ours {points:,}" in figure.title
    picture = cv2.imdecode(np.frombuffer(figure.png, np.uint8), cv2.IMREAD_COLOR)
    assert picture.std() > 20


def test_the_weights_are_named_in_rows_of_their_own(data: Path) -> None:
    second = DeepDetect().weights
    options = BenchmarkOptions(DeepDetect(), ("paper",), (), geometry_weights=("dense", second))
    titles = [way.title for way in pipelines(options)]
    assert titles[:2] == ["ours, weights dense", "ours, weights default"]
    assert sum(title.startswith("published pipeline") for title in titles) == 2
    assert len(set(titles)) == len(titles)


def test_weights_of_one_name_are_refused(tmp_path: Path, one_line) -> None:
    """One row would hide the other."""
    with pytest.raises(OptionError, match="rename") as caught:
        BenchmarkOptions(DeepDetect(), geometry_weights=("a/model.onnx", "b/model.onnx"))
    one_line(caught.value)


def test_the_weights_for_stereo_are_run_as_the_others() -> None:
    detector = DeepDetect(backend="onnxruntime", threads=1)
    found = BenchmarkOptions(detector, ("paper",), ()).geometry_detectors()["dense"]
    assert found.backend == "onnxruntime"
    assert found.weights == DeepDetect("dense").weights


def test_times_of_other_runs_are_not_compared(data: Path, tmp_path: Path) -> None:
    """What was measured earlier stays in the cache; only the points may be used then."""
    cache = StageCache(tmp_path / "cache")
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "cones").symlink_to(data / "middlebury" / "cones")
    options = BenchmarkOptions(DeepDetect(), ("paper",), ())

    def faster(geometry: tuple[str | Path, ...]) -> dict[str, object]:
        workspace = Workspace(tmp_path / "scenes", cache)
        chosen = dataclasses.replace(options, geometry_weights=geometry)
        (found,) = middlebury_sections(workspace, chosen)
        return {
            name: row["times faster than published"]
            for name, row in rows(found, "middlebury_cones").items()
        }

    first = faster(("dense",))
    assert (first["ours, weights dense"] or 0) > 1
    assert faster(("dense",)) == first
    later = faster(("dense", DeepDetect().weights))
    assert later["ours, weights dense"] == first["ours, weights dense"]
    assert later["ours, weights default"] is None


def test_voxels_are_cubes_with_a_point() -> None:
    camera = Camera((101, 101), 100.0)
    calibration = Calibration(camera, camera, baseline_mm=10)
    # Depth 1000 / disparity; at a depth of 100 mm a pixel is 1 mm.
    pixels = np.array([[50.2, 50.2], [50.7, 50.2], [53.2, 50.2], [50.2, 50.2], [10, 10]])
    disparity = np.array([10.0, 10, 10, 5, -1])
    assert voxels(calibration, pixels, disparity, 2.0) == 3


def test_sgbm_finds_a_shift() -> None:
    texture = np.random.default_rng(0).integers(0, 256, (80, 200, 3), np.uint8)
    texture = cv2.GaussianBlur(texture, (0, 0), 1)
    left, right = texture[:, :180], texture[:, 9:189]
    camera = Camera((180, 80), 100.0)

    found = sgbm(
        CalibratedStereoPair(
            "shift", left, right, np.full(left.shape[:2], np.nan), Calibration(camera, camera)
        )
    )
    assert (np.abs(found.disparity - 9) < 0.5).mean() > 0.98
    assert len(found.pixels) > 0.9 * 80 * 171


def test_the_published_pipeline_keeps_what_lies_on_a_row(data: Path) -> None:
    scene = load_calibrated_pair(data / "middlebury" / "cones")
    detector = published_detector(DeepDetect("dense").configured(HeatmapOptions(480, "bgr")))
    stages: list[str] = []
    points0, points1 = published_points(
        (scene.left, scene.right), detector, SETTINGS["cones"], stages.append
    )
    assert stages == list(STAGES)
    assert len(points0) == len(points1) > 5_000
    assert (np.abs(points0[:, 1] - points1[:, 1]) <= 1).mean() > 0.98
