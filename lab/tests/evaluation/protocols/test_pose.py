"""Poses of a wall and a post whose cameras are known, and counts of results that are made up."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from deepdetect import DeepDetect
from deepdetect.geometry.camera import Camera
from deepdetect_lab.datasets.posed_images import (
    PosedImage,
    PosedPair,
    PosedScene,
    load_posed_scenes,
)
from deepdetect_lab.evaluation.benchmarks import run_benchmarks
from deepdetect_lab.evaluation.metrics.pose import rotation_error, translation_error
from deepdetect_lab.evaluation.options import BenchmarkOptions
from deepdetect_lab.evaluation.protocols.pose import (
    STRAIGHT_AHEAD,
    PoseMethod,
    estimate_pose,
    pose_methods,
    pose_row,
    scene_table,
)
from deepdetect_lab.evaluation.report import Report, Rows, Table
from deepdetect_lab.evaluation.run import Run

SIFT = "SIFT, ratio 0.8"
INF = float("inf")
METHODS = (
    PoseMethod("DeepDetect", "DeepDetect"),
    PoseMethod("sift", SIFT),
    PoseMethod("straight", STRAIGHT_AHEAD),
)
TITLES = [method.title for method in METHODS]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, facade) -> Path:
    """The facade's two views as a KITTI clip; the second camera stands right of the first."""
    root = tmp_path_factory.mktemp("pose")
    drawn = facade(0.3)
    for number, view in enumerate((drawn.left, drawn.right)):
        Image.fromarray(view).save(root / f"{number:06d}.png")
    axes = cv2.Rodrigues(np.radians([1.0, -3.0, 2.0]))[0].T
    poses = np.eye(3, 4), np.column_stack([axes, [1.0, 0.06, 0.1]])
    projection = np.column_stack([drawn.camera, np.zeros(3)])
    (root / "calib.txt").write_text(" ".join(map(str, projection.ravel())))
    (root / "poses.txt").write_text("\n".join(" ".join(map(str, p.ravel())) for p in poses))
    return root


@pytest.fixture(scope="module")
def report(folder: Path, edge_detector: DeepDetect) -> Report:
    options = BenchmarkOptions(edge_detector, classical=("sift", "orb"))
    return run_benchmarks(["pose"], folder, options)


def rows(table: Table) -> dict[str, dict[str, object]]:
    return {row["method"]: row for row in table.rows}


def find(report: Report, key: str) -> Table:
    (table,) = [table for table in report.tables() if table.key == key]
    return table


@pytest.mark.slow
def test_all_methods_find_the_pose_and_the_control_does_not(report: Report, folder: Path) -> None:
    assert report.skipped == ()
    found = rows(find(report, "pose"))
    assert list(found) == [
        *("DeepDetect", "DeepDetect, unguided", SIFT, "ORB, ratio 0.8", STRAIGHT_AHEAD)
    ]
    for title in ("DeepDetect", SIFT):
        assert found[title]["median error, °"] < 3
        assert found[title]["agreeing within 1 px"] > 0.8
        assert found[title]["matches"] > 50
        assert found[title]["seconds"] > 0
    control = found[STRAIGHT_AHEAD]
    # The second camera stands at (1, .06, .1): almost at a right angle to straight ahead.
    true = np.degrees(np.arccos(0.1 / np.linalg.norm([1, 0.06, 0.1])))
    assert control["median error, °"] == pytest.approx(true, abs=4)
    assert control["matches"] is control["agreeing within 1 px"] is control["seconds"] is None
    assert control["worse than SIFT"] == 1
    guides = [found["DeepDetect"][k] for k in ("guided by homography", "guided by fundamental")]
    assert sum(guides) + found["DeepDetect"]["unguided"] == 1
    assert found[SIFT]["unguided"] is found["DeepDetect, unguided"]["unguided"] is None


@pytest.fixture
def scene() -> PosedScene:
    camera = Camera((64, 48), 100, (0, 0))
    image = PosedImage("0.png", camera, np.eye(3), np.zeros(3), Path("0.png"))
    pairs = tuple(PosedPair("clip", image, image, distance) for distance in (1, 1, 1, 3))
    return PosedScene("clip", (image,), pairs)


@pytest.fixture
def found() -> Rows:
    ours = (1.0, 4.9, 5.0, INF)
    theirs = (4.0, 6.0, 4.9, 2.0)
    kinds = ("homography", "fundamental", "fundamental", "none")
    errors = ("rotation error, °", "translation error, °")
    names = (*errors, "matches", "agreeing within 1 px", "seconds", "guided by")
    rows = []
    for k in range(4):
        for method, values in (
            ("DeepDetect", (ours[k], 0.5, 10 * k, 0.25 * k, 3.0, kinds[k])),
            ("sift", (0.5, theirs[k], 7, 1.0, 1.0, None)),
            ("straight", (0.0, 0.0, None, None, None, None)),
        ):
            row = dict(zip(names, values, strict=True))
            row |= {"method": method, "item": f"clip {k}", "scene": "clip", "pair": f"pair {k}"}
            rows.append(row | {"pose error, °": max(values[:2])})
    return rows


def test_losses_are_counted_beside_wins(scene: PosedScene, found: Rows) -> None:
    table = rows(scene_table([scene], METHODS, found))
    ours = table["DeepDetect"]
    # Pair 1 is a win, pairs 2 (5 degrees are too many) and 3 (failed) are losses.
    assert (ours["worse than SIFT"], ours["better than SIFT"]) == (2, 1)
    assert (ours["pairs"], ours["failed"]) == (4, 1)
    # (0, 0), (1, 1/4), (4.9, 2/4), level to 5.
    area = 0.125 + 3.9 * 0.375 + 0.1 * 0.5
    assert ours["AUC at 5°"] == pytest.approx(area / 5)
    assert ours["matches"] == 15
    assert ours["agreeing within 1 px"] == 0.375
    guides = [ours[name] for name in ("guided by homography", "guided by fundamental", "unguided")]
    assert guides == [1, 2, 1]
    assert table[SIFT]["worse than SIFT"] is table[SIFT]["better than SIFT"] is None
    assert table[SIFT]["guided by homography"] is None
    assert table[STRAIGHT_AHEAD]["AUC at 20°"] == 1
    assert table[STRAIGHT_AHEAD]["better than SIFT"] == 1


def test_pairs_that_were_skipped_are_in_no_count(scene: PosedScene, found: Rows) -> None:
    lacking = (("sift", "clip 1"), ("DeepDetect", "clip 3"))
    left = [row for row in found if (row["method"], row["item"]) not in lacking]
    table = rows(scene_table([scene], METHODS, left))
    assert [table[title]["pairs"] for title in TITLES] == [3, 3, 4]
    ours = table["DeepDetect"]
    assert (ours["worse than SIFT"], ours["better than SIFT"], ours["failed"]) == (1, 0, 0)
    nothing = rows(scene_table([scene], METHODS, []))["DeepDetect"]
    assert (nothing["pairs"], nothing["AUC at 5°"], nothing["seconds"]) == (0, None, None)


def test_a_second_run_reads_what_the_first_has_kept(folder: Path, tmp_path: Path) -> None:
    (pair,) = load_posed_scenes(folder)[0].pairs
    world = np.random.default_rng(0).uniform((-3, -2, 5), (3, 2, 10), (60, 3))
    seen = world, world @ pair.rotation.T + pair.translation
    points = [(p @ pair.first.camera.matrix.T / p[:, 2:])[:, :2] for p in seen]
    method = PoseMethod("made up", "Made up", lambda _: (*points, 2.5, "fundamental"))
    runs = Run(folder, tmp_path), Run(folder, tmp_path)
    once, again = (pose_row(run, method, pair) for run in runs)
    assert [run.made for run in runs] == [1, 0]
    assert once == again
    assert once["pose error, °"] < 0.1
    assert (once["matches"], once["agreeing within 1 px"], once["seconds"]) == (60, 1.0, 2.5)
    assert once["guided by"] == "fundamental"


def test_too_few_matches_are_a_failure_not_an_error(folder: Path) -> None:
    (pair,) = load_posed_scenes(folder)[0].pairs
    nothing = np.empty((0, 2)), np.empty((0, 2)), 1.0, ""
    found = pose_row(Run(folder), PoseMethod("nothing", "Nothing", lambda _: nothing), pair)
    assert found["rotation error, °"] == found["pose error, °"] == INF
    assert (found["matches"], found["agreeing within 1 px"]) == (0, 0.0)


@pytest.mark.slow
def test_sift_is_right_on_the_fountain_and_straight_ahead_on_the_clip(
    shared: Path, edge_detector: DeepDetect
) -> None:
    """Cameras that were read wrongly would make both fail."""
    run = Run(shared)
    options = BenchmarkOptions(edge_detector, classical=("sift",))
    methods = {method.title: method for method in pose_methods(run, options)}
    scenes = load_posed_scenes(shared / "data")
    pairs = {pair.name: pair for scene in scenes for pair in scene.pairs}
    near = pose_row(run, methods[SIFT], pairs["fountain 0004-0005"])
    assert near["pose error, °"] < 1
    assert near["agreeing within 1 px"] > 0.9
    driving = pairs["kitti-clip 000020-000025"]
    assert pose_row(run, methods[SIFT], driving)["pose error, °"] < 2
    assert pose_row(run, methods[STRAIGHT_AHEAD], driving)["pose error, °"] < 3


FIRST = np.array([[500.0, 0, 310], [0, 520, 250], [0, 0, 1]])
SECOND = np.array([[900.0, 0, 450], [0, 880, 280], [0, 0, 1]])
ROTATION = cv2.Rodrigues(np.array([0.05, -0.2, 0.1]))[0]
TRANSLATION = np.array([-0.9, 0.1, 0.3])


@pytest.fixture
def points() -> tuple[np.ndarray, np.ndarray]:
    """300 matches of cameras with other focal lengths, to 0.3 px."""
    rng = np.random.default_rng(1)
    world = rng.uniform((-4, -3, 6), (4, 3, 16), (300, 3))
    seen = world, world @ ROTATION.T + TRANSLATION
    first, second = (
        (one @ camera.T / one[:, 2:])[:, :2] + rng.normal(0, 0.3, (300, 2))
        for one, camera in zip(seen, (FIRST, SECOND), strict=True)
    )
    return first, second


@pytest.mark.parametrize("wrong", [0, 100])
def test_the_pose_is_found_among_wrong_matches(points, wrong: int) -> None:
    first, second = points
    second = second.copy()
    second[:wrong] = np.random.default_rng(2).uniform(0, 600, (wrong, 2))
    rotation, translation = estimate_pose(first, second, FIRST, SECOND)
    assert rotation_error(rotation, ROTATION) < 0.3
    assert translation_error(translation, TRANSLATION) < 1.5
    assert np.linalg.norm(translation) == pytest.approx(1)


def test_far_points_do_not_lose_their_side() -> None:
    """A hundred baselines away, where OpenCV's default leaves points out."""
    world = np.random.default_rng(0).uniform((-60, -40, 90), (60, 40, 200), (400, 3))
    first, second = ((p @ FIRST.T / p[:, 2:])[:, :2] for p in (world, world - [1.0, 0, 0]))
    _, translation = estimate_pose(first, second, FIRST, FIRST)
    assert translation_error(translation, np.array([-1.0, 0, 0])) < 5


@pytest.mark.parametrize("count", [0, 5, 20])
def test_without_enough_matches_there_is_no_pose(count: int) -> None:
    same = np.full((count, 2), 50.0)
    assert estimate_pose(same, same, FIRST, SECOND) is None
