"""The tables of reconstructions of many photographs, and a whole run on small ones."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from deepdetect import DeepDetect, MissingExtraError, reconstruct_many
from deepdetect.datasets.posed_images import PosedImage, PosedPair, PosedScene, load_posed_scenes
from deepdetect.evaluation.benchmarks import run_benchmarks
from deepdetect.evaluation.options import BenchmarkOptions
from deepdetect.evaluation.protocols import sfm, sfm_methods
from deepdetect.evaluation.protocols.sfm import (
    SfmModel,
    SfmScene,
    camera_table,
    choose_images,
    cost_table,
    error_figure,
)
from deepdetect.evaluation.protocols.sfm_methods import SfmMethod
from deepdetect.evaluation.report import Table
from deepdetect.evaluation.run import Run
from deepdetect.geometry.camera import PosedView

POINTS, SIFT, RANDOM = (
    "DeepDetect, points",
    "SIFT, pycolmap",
    "baseline: as many random points",
)
NOTHING = SfmModel({}, 0, float("nan"), float("nan"), 1.5)


def images(folder: Path, count: int) -> tuple[PosedImage, ...]:
    """Cameras on an arc with radius 10; all have one file."""
    found = []
    for number in range(count):
        path = folder / f"{number:06}.png"
        if not path.exists():
            cv2.imwrite(str(path), np.zeros((48, 64), np.uint8))
        rotation = cv2.Rodrigues(np.array([0.02 * number**2, 0.1 * number, 0]))[0]
        matrix = np.array([[50.0, 0, 31.5], [0, 50, 23.5], [0, 0, 1]])
        found.append(PosedImage(path, matrix, rotation, np.array([0.0, 0, 10])))
    return tuple(found)


@pytest.fixture
def scene(tmp_path: Path) -> SfmScene:
    return SfmScene("arc", images(tmp_path, 5))


def by_column(table: Table, row: int) -> dict:
    titles = [column.title for column in table.columns]
    return dict(zip(titles, table.rows[row], strict=True))


def method(title: str) -> SfmMethod:
    return SfmMethod(title, sfm_methods.find_sift)


@pytest.fixture
def groups(scene: SfmScene) -> list:
    # Twice as large, in another frame, and one is missing.
    turn = cv2.Rodrigues(np.array([0.5, -1, 0.2]))[0]
    own = {
        name: PosedView(
            name, view.camera, view.rotation @ turn.T, -view.rotation @ turn.T @ (2 * turn @ c)
        )
        for name, view in list(scene.truth.items())[:4]
        for c in (view.centre,)
    }
    good = SfmModel(own, 1000, 3.5, 0.25, 3.0)
    cost = {"keypoints": 800, "matches": 5000, "seconds": 10.0, "cpu seconds": 12.0, "memory": 4e8}
    return [
        (scene, method(POINTS), {"true": good, "estimated": NOTHING, **cost}),
        (scene, method(RANDOM), {"true": NOTHING, "estimated": NOTHING, **cost}),
    ]


def test_cameras_are_compared_after_the_alignment(groups: list) -> None:
    table = camera_table(groups)
    assert [row[1:5] for row in table.rows] == [
        (POINTS, "true", 5, 4),
        (POINTS, "estimated", 5, 0),
        (RANDOM, "true", 5, 0),
        (RANDOM, "estimated", 5, 0),
    ]
    ours = by_column(table, 0)
    # 6 of 10 pairs are exact, the others have no pose.
    for threshold in ("0.5", "1", "5"):
        assert ours[f"AUC at {threshold}°"] == pytest.approx(0.6, abs=0.01)
    assert ours["centres, unit of the truth"] == pytest.approx(0, abs=1e-9)
    assert ours["rotations, °"] == pytest.approx(0, abs=1e-4)
    assert (ours["sparse points"], ours["track length"]) == (1000, 3.5)
    nothing = by_column(table, 2)
    assert nothing["AUC at 5°"] == 0
    assert nothing["centres, ‰ of the extent"] is nothing["rotations, °"] is None


def test_an_error_of_a_centre_has_its_size(scene: SfmScene, groups: list) -> None:
    model = groups[0][2]["true"]
    name, view = next(iter(model.views.items()))
    moved = view.centre + [0.02, 0, 0]  # 0.01 of the truth
    model.views[name] = PosedView(name, view.camera, view.rotation, -view.rotation @ moved)
    row = by_column(camera_table(groups), 0)
    error = row["centres, unit of the truth"]
    assert 0.001 < error < 0.01
    centres = [view.centre for view in scene.truth.values()]
    extent = max(np.linalg.norm(a - b) for a in centres for b in centres)
    assert row["centres, ‰ of the extent"] == pytest.approx(1000 * error / extent)


def test_models_are_compared_with_the_first_in_the_unit_of_the_truth(
    scene: SfmScene, groups: list
) -> None:
    first = groups[0][2]["true"]
    half = {  # in a unit of its own, and one camera is 0.03 of the truth's aside
        name: PosedView(
            name, view.camera, view.rotation, -view.rotation @ (0.5 * view.centre + [move, 0, 0])
        )
        for (name, view), move in zip(first.views.items(), (0.03, 0, 0, 0), strict=True)
    }
    other = SfmModel(half, 1, 2.0, 0.1, 1.0)
    groups.insert(1, (scene, method(SIFT), {"true": other, "estimated": first}))
    table = camera_table(groups)
    column = "from the first row's, unit of the truth"
    values = [by_column(table, row)[column] for row in range(6)]
    assert values[0] is values[1] is values[3] is values[4] is None
    assert 0.005 < values[2] < 0.03


def test_costs_are_those_of_the_process(scene: SfmScene, groups: list) -> None:
    table = cost_table(groups)
    assert table.rows[0] == ("arc", POINTS, 800, 5000, 10, 12, 3, 1.5, 400)
    assert error_figure(scene, groups).png.startswith(b"\x89PNG")


def test_images_of_a_sequence_are_its_first(tmp_path: Path) -> None:
    all_images = images(tmp_path, 9)
    pair = all_images[0], all_images[1]
    sequence = PosedScene("clip", all_images, (PosedPair("clip", *pair, 1),))
    unordered = PosedScene("set", all_images, (PosedPair("set", *pair),))
    stems = [[int(i.path.stem) for i in choose_images(s, 5).images] for s in (sequence, unordered)]
    assert stems == [[0, 1, 2, 3, 4], [0, 2, 4, 6, 8]]
    assert len(choose_images(unordered, 20).images) == 9


def test_options_choose_the_methods() -> None:
    detector = DeepDetect()
    titles = [method.title for method in sfm.sfm_methods(BenchmarkOptions(detector))]
    assert titles == [POINTS, SIFT, RANDOM]
    without = sfm.sfm_methods(BenchmarkOptions(detector, classical=()))
    assert [method.title for method in without] == [POINTS, RANDOM]


def test_without_pycolmap_it_says_what_to_install(
    write_posed_fountain, tmp_path: Path, monkeypatch, edge_detector: DeepDetect
) -> None:
    folder = write_posed_fountain(tmp_path / "fountain", ("0004", "0005", "0006"))
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(MissingExtraError, match="pycolmap"):
        sfm.sfm(Run(folder), BenchmarkOptions(edge_detector))


def test_what_cannot_be_reconstructed_is_a_result(
    write_posed_fountain, tmp_path: Path, monkeypatch
) -> None:
    """Without matches no images hang together: none is registered."""
    pytest.importorskip("pycolmap", reason="needs pycolmap")
    folder = write_posed_fountain(tmp_path / "fountain", ("0004", "0005", "0006"), 128)

    def nothing(stages, pairs):
        return {pair: np.empty((0, 2), np.int64) for pair in pairs}

    unmatched = SfmMethod("nothing", sfm_methods.find_sift, nothing)
    monkeypatch.setattr(sfm, "run_in_child", lambda function, task: function(task))
    chosen = choose_images(load_posed_scenes(folder)[0], 20)
    found = sfm.measure_scene(Run(folder), unmatched, chosen)
    assert (len(found["true"].views), len(found["estimated"].views)) == (0, 0)
    assert found["memory"] > 1e7


@pytest.mark.slow
def test_a_whole_run_on_small_images(write_posed_fountain, tmp_path: Path) -> None:
    pytest.importorskip("pycolmap", reason="needs pycolmap")
    names = [f"{number:04}" for number in range(2, 8)]
    folder = write_posed_fountain(tmp_path / "fountain", names)
    options = BenchmarkOptions(DeepDetect())
    report = run_benchmarks(["sfm"], folder, options, cache=tmp_path / "cache")
    assert report.failures == ()
    cameras, _ = report.tables()
    lines = [by_column(cameras, k) for k in range(len(cameras.rows))]
    given = {row["keypoints"]: row for row in lines if row["intrinsics"] == "true"}
    assert given[POINTS]["registered"] == given[SIFT]["registered"] == 6
    assert min(given[title]["AUC at 5°"] for title in (POINTS, SIFT)) > 0.9
    assert given[RANDOM]["AUC at 1°"] < given[POINTS]["AUC at 1°"]
    # The row is what the command gives.
    model = reconstruct_many(
        sorted(folder.glob("*.jpg")), tmp_path / "model", dense=False, workers=1
    )
    assert (lines[1]["keypoints"], lines[1]["intrinsics"]) == (POINTS, "estimated")
    assert lines[1]["sparse points"] == pytest.approx(len(model.sparse), rel=0.02)
    # A second run finds all in the cache.
    again = run_benchmarks(["sfm"], folder, options, cache=tmp_path / "cache")
    assert again.metadata["results made, not found in the cache"] == "0"
    assert [table.rows for table in again.tables()] == [table.rows for table in report.tables()]
