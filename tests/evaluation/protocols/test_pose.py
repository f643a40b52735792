"""Poses of a wall and a post whose cameras are known, and counts of results that are made up."""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from deepdetect import DeepDetect
from deepdetect.datasets.pair_selection import PairSelectionOptions
from deepdetect.datasets.posed_images import (
    PosedImage,
    PosedPair,
    PosedScene,
    load_posed_scenes,
)
from deepdetect.evaluation.cache import StageCache
from deepdetect.evaluation.context import BenchmarkContext
from deepdetect.evaluation.options import BenchmarkOptions
from deepdetect.evaluation.protocols.pose import (
    PoseResult,
    distance_table,
    measure_pair,
    pair_table,
    pose_table,
)
from deepdetect.evaluation.protocols.pose_methods import (
    SIFT,
    STRAIGHT_AHEAD,
    FoundMatches,
    PoseMethod,
    pose_methods,
)
from deepdetect.evaluation.report import Report, Table
from deepdetect.evaluation.runner import run_benchmarks

INF = float("inf")
TITLES = ("DeepDetect", SIFT, STRAIGHT_AHEAD)


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


def rows(table: Table, name: str = "method") -> dict[str, dict[str, object]]:
    titles = [column.title for column in table.columns]
    found = [dict(zip(titles, row, strict=True)) for row in table.rows]
    return {str(row[name]): row for row in found}


def find(report: Report, key: str) -> Table:
    (table,) = [table for table in report.tables() if table.key == key]
    return table


@pytest.mark.slow
def test_all_methods_find_the_pose_and_the_control_does_not(report: Report, folder: Path) -> None:
    assert report.skipped == ()
    found = rows(find(report, "pose"))
    assert list(found) == [
        *("DeepDetect", "DeepDetect, unguided", SIFT, "ORB, ratio 0.8", STRAIGHT_AHEAD),
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


@pytest.mark.slow
def test_the_report_has_the_files_and_says_what_the_control_is(
    report: Report, folder: Path, tmp_path: Path
) -> None:
    report.save(tmp_path)
    text = (tmp_path / "report.md").read_text()
    assert "a control that sees no image" in text
    assert "no test of that choice" in text
    assert "In `tables/pose_pairs.csv`." in text
    key = folder.name.replace("-", "_")
    assert (tmp_path / "figures" / f"pose_{key}.png").is_file()
    with (tmp_path / "tables" / "pose_pairs.csv").open() as file:
        pairs = list(csv.DictReader(file))
    assert len(pairs) == 5
    assert {row["pair"] for row in pairs} == {f"{folder.name} 000000-000001"}
    assert {row["frame distance"] for row in pairs} == {"1"}
    assert f"{folder.name}, by frame distance" in text
    assert text.count(f"| 1 | {SIFT} |") == 1


def image(number: int) -> PosedImage:
    """Cameras that move forward."""
    return PosedImage(
        Path(f"{number}.png"), np.diag([100.0, 100, 1]), np.eye(3), np.array([0, 0, -1.0 * number])
    )


@pytest.fixture
def scene() -> PosedScene:
    images = tuple(map(image, range(5)))
    pairs = tuple(
        PosedPair("clip", images[a], images[b], b - a) for a, b in ((0, 1), (1, 2), (2, 3), (0, 3))
    )
    return PosedScene("clip", images, pairs)


@pytest.fixture
def found() -> dict:
    ours = (1.0, 4.9, 5.0, INF)
    theirs = (4.0, 6.0, 4.9, 2.0)
    kinds = ("homography", "fundamental", "fundamental", "none")
    results = {}
    for number in range(4):
        mine = PoseResult(ours[number], 0.5, 10 * number, 0.25 * number, 3.0, kinds[number])
        results["clip", number, "DeepDetect"] = mine
        results["clip", number, SIFT] = PoseResult(0.5, theirs[number], 7, 1.0, 1.0)
        results["clip", number, STRAIGHT_AHEAD] = PoseResult(0.0, 0.0)
    return results


def test_losses_are_counted_beside_wins(scene: PosedScene, found: dict) -> None:
    table = rows(pose_table([scene], TITLES, found))
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


def test_pairs_that_were_skipped_are_in_no_count(scene: PosedScene, found: dict) -> None:
    del found["clip", 1, SIFT], found["clip", 3, "DeepDetect"]
    table = rows(pose_table([scene], TITLES, found))
    assert [table[title]["pairs"] for title in TITLES] == [3, 3, 4]
    ours = table["DeepDetect"]
    assert (ours["worse than SIFT"], ours["better than SIFT"], ours["failed"]) == (1, 0, 0)
    nothing = rows(pose_table([scene], TITLES, {}))["DeepDetect"]
    assert (nothing["pairs"], nothing["AUC at 5°"], nothing["seconds"]) == (0, None, None)


def test_each_frame_distance_has_its_pairs(scene: PosedScene, found: dict) -> None:
    table = distance_table(scene, TITLES, found)
    assert table.key == "pose_clip_distances"
    assert [row[:3] for row in table.rows] == [
        (distance, title, count) for distance, count in ((1, 3), (3, 1)) for title in TITLES
    ]
    assert table.rows[3][3] == 1  # of ours, the one that failed


def test_the_table_of_all_pairs_has_both_errors(scene: PosedScene, found: dict) -> None:
    table = pair_table([scene], TITLES, found)
    assert not table.in_text
    assert len(table.rows) == 12
    assert table.rows[4] == ("clip 1-2", SIFT, 1, 0.5, 6.0, 6.0, 7, 1.0, None, 1.0)


def test_a_second_run_reads_what_the_first_has_kept(folder: Path, tmp_path: Path) -> None:
    (pair,) = load_posed_scenes(folder, PairSelectionOptions())[0].pairs
    world = np.random.default_rng(0).uniform((-3, -2, 5), (3, 2, 10), (60, 3))
    seen = world, world @ pair.rotation.T + pair.translation
    points = [(p @ pair.first.intrinsics.T / p[:, 2:])[:, :2] for p in seen]
    calls = []

    def match(asked: PosedPair) -> FoundMatches:
        calls.append(asked)
        return FoundMatches(*points, seconds=2.5, guided_by="fundamental")

    method = PoseMethod("made up", match, lambda _: {"feature": "made up"})
    context = BenchmarkContext(folder, StageCache(tmp_path))
    once, again = (measure_pair(context, method, pair) for _ in range(2))
    assert len(calls) == 1
    assert once == again
    assert once.error_deg < 0.1
    assert (once.matches, once.agreeing, once.seconds) == (60, 1.0, 2.5)
    assert once.guided_by == "fundamental"


def test_too_few_matches_are_a_failure_not_an_error(folder: Path) -> None:
    (pair,) = load_posed_scenes(folder)[0].pairs
    nothing = FoundMatches(np.empty((0, 2)), np.empty((0, 2)), 1.0)
    method = PoseMethod("nothing", lambda _: nothing)
    found = measure_pair(BenchmarkContext(folder), method, pair)
    assert found == PoseResult(INF, INF, 0, 0.0, 1.0)
    assert found.error_deg == INF


@pytest.mark.slow
def test_sift_is_right_on_the_fountain_and_straight_ahead_on_the_clip(
    shared: Path, edge_detector: DeepDetect
) -> None:
    """Cameras that were read wrongly would make both fail."""
    context = BenchmarkContext(shared)
    options = BenchmarkOptions(edge_detector, classical=("sift",))
    methods = {method.title: method for method in pose_methods(context, options)}
    fountain, clip = load_posed_scenes(shared / "data")
    pairs = {pair.name: pair for pair in (*fountain.pairs, *clip.pairs)}
    near = measure_pair(context, methods[SIFT], pairs["fountain 0004-0005"])
    assert near.error_deg < 1
    assert near.agreeing is not None
    assert near.agreeing > 0.9
    driving = measure_pair(context, methods[SIFT], pairs["kitti-clip 000020-000025"])
    assert driving.error_deg < 2
    ahead = measure_pair(context, methods[STRAIGHT_AHEAD], pairs["kitti-clip 000020-000025"])
    assert ahead.error_deg < 3
