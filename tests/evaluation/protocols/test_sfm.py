"""The tables of reconstructions of many photographs, and a whole run on small ones."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from deepdetect import DeepDetect, MissingExtraError, OptionError, reconstruct_many
from deepdetect.datasets.posed_images import PosedImage, PosedPair, PosedScene
from deepdetect.evaluation.benchmarks import plan_sfm
from deepdetect.evaluation.context import BenchmarkContext
from deepdetect.evaluation.metrics.multi_view import CloudAgreement
from deepdetect.evaluation.options import BenchmarkOptions, SfmOptions
from deepdetect.evaluation.protocols import sfm
from deepdetect.evaluation.protocols.sfm import (
    POINTS,
    RANDOM,
    SIFT,
    SfmScene,
    camera_table,
    choose_photographs,
    cost_table,
    dense_table,
    error_figure,
    photograph_table,
    sfm_methods,
)
from deepdetect.evaluation.protocols.sfm_results import SfmModel, SfmResult
from deepdetect.evaluation.report import Table
from deepdetect.evaluation.runner import run_benchmarks
from deepdetect.geometry.posed_view import PosedView

NAN = float("nan")


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


@pytest.fixture
def found(scene: SfmScene) -> dict:
    truth = scene.truth
    # Twice as large, in another frame, and one is missing.
    turn = cv2.Rodrigues(np.array([0.5, -1, 0.2]))[0]
    own = {
        name: PosedView(
            name, view.camera, view.rotation @ turn.T, -view.rotation @ turn.T @ (2 * turn @ c)
        )
        for name, view in list(truth.items())[:4]
        for c in (view.centre,)
    }
    good = SfmModel(own, 1000, 3.5, 0.25, 2.0, 3.0)
    none = SfmModel({}, 0, NAN, NAN, 1.0, 1.5)
    one, other = (
        CloudAgreement(points, covered, px, 0.001, (0.1, 0.2, 0.3, 0.4, 0.5))
        for points, covered, px in ((300, 0.9, 0.2), (100, 0.5, 0.6))
    )
    ours = SfmResult(
        800, 5000, 10.0, 12.0, good, none, 400_000_000, (300, 100), 30.0, 700_000_000, (one, other)
    )
    chance = SfmResult(800, 50, 5.0, 6.0, none, none, 300_000_000)
    return {("arc", POINTS): ours, ("arc", RANDOM): chance}


def test_cameras_are_compared_after_the_alignment(scene: SfmScene, found: dict) -> None:
    table = camera_table([scene], [POINTS, SIFT, RANDOM], found)
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


def test_an_error_of_a_centre_has_its_size(scene: SfmScene, found: dict) -> None:
    model = found["arc", POINTS].given
    name, view = next(iter(model.views.items()))
    moved = view.centre + [0.02, 0, 0]  # 0.01 of the truth
    model.views[name] = PosedView(name, view.camera, view.rotation, -view.rotation @ moved)
    table = camera_table([scene], [POINTS], found)
    error = by_column(table, 0)["centres, unit of the truth"]
    assert 0.001 < error < 0.01
    centres = [view.centre for view in scene.truth.values()]
    extent = max(np.linalg.norm(a - b) for a in centres for b in centres)
    relative = by_column(table, 0)["centres, ‰ of the extent"]
    assert relative == pytest.approx(1000 * error / extent)
    each = photograph_table([scene], [POINTS], found)
    assert not each.in_text
    assert len(each.rows) == 10
    errors = [row[4] for row in each.rows[:4]]
    assert np.mean(errors) == pytest.approx(error)
    assert each.rows[4][3:] == ("000004.png", None, None)


def test_models_are_compared_with_the_first_in_the_unit_of_the_truth(
    scene: SfmScene, found: dict
) -> None:
    first = found["arc", POINTS].given
    half = {  # in a unit of its own, and one camera is 0.03 of the truth's aside
        name: PosedView(
            name, view.camera, view.rotation, -view.rotation @ (0.5 * view.centre + [move, 0, 0])
        )
        for (name, view), move in zip(first.views.items(), (0.03, 0, 0, 0), strict=True)
    }
    other = SfmModel(half, 1, 2.0, 0.1, 1.0, 1.0)
    exact = SfmModel(dict(first.views), 1, 2.0, 0.1, 1.0, 1.0)
    found["arc", SIFT] = SfmResult(1, 1, 1.0, 1.0, other, exact, 1)
    table = camera_table([scene], [POINTS, SIFT, RANDOM], found)
    column = "from the first row's, unit of the truth"
    values = [by_column(table, row)[column] for row in range(6)]
    assert values[0] is values[1] is values[3] is values[4] is None
    assert 0.005 < values[2] < 0.03


def test_halves_count_by_their_points(scene: SfmScene, found: dict) -> None:
    table = dense_table([scene], [POINTS, RANDOM], found)
    ours = by_column(table, 0)
    assert ours["dense points"] == 400
    assert ours["covered"] == pytest.approx(0.8)
    assert ours["median distance, px"] == pytest.approx(0.3)
    assert ours["median distance, ‰ of the depth"] == pytest.approx(1)
    assert ours["within 0.5 px"] == pytest.approx(0.3)
    assert table.rows[1] == ("arc", RANDOM, 0, *[None] * (len(table.columns) - 3))


def test_costs_are_those_of_the_process(scene: SfmScene, found: dict) -> None:
    table = cost_table([scene], [POINTS, RANDOM], found)
    assert table.rows[0] == ("arc", POINTS, 800, 5000, 10, 12, 3, 1.5, 400, 30, 700)
    assert table.rows[1][-3:] == (300, None, None)
    assert error_figure(scene, [POINTS], found).png.startswith(b"\x89PNG")


def test_photographs_of_a_sequence_are_its_first(tmp_path: Path) -> None:
    all_images = images(tmp_path, 9)
    pair = all_images[0], all_images[1]
    sequence = PosedScene("clip", all_images, (PosedPair("clip", *pair, 1),))
    unordered = PosedScene("set", all_images, (PosedPair("set", *pair),))
    stems = [
        [int(i.path.stem) for i in choose_photographs(s, 5).images] for s in (sequence, unordered)
    ]
    assert stems == [[0, 1, 2, 3, 4], [0, 2, 4, 6, 8]]
    assert len(choose_photographs(unordered, 20).images) == 9


def test_options_choose_the_methods() -> None:
    detector = DeepDetect()
    titles = [method.title for method in sfm_methods(BenchmarkOptions(detector))]
    assert titles == [POINTS, SIFT, RANDOM]
    without = sfm_methods(BenchmarkOptions(detector, classical=()))
    assert [method.title for method in without] == [POINTS, RANDOM]
    with pytest.raises(OptionError, match="max_photographs"):
        SfmOptions(max_photographs=2)


def test_without_pycolmap_it_says_what_to_install(
    write_posed_fountain, tmp_path: Path, monkeypatch, edge_detector: DeepDetect
) -> None:
    folder = write_posed_fountain(tmp_path / "fountain", ("0004", "0005", "0006"))
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(MissingExtraError, match=r"deepdetect\[sfm\]"):
        plan_sfm(BenchmarkContext(folder), BenchmarkOptions(edge_detector))


def test_what_cannot_be_reconstructed_is_a_result(
    write_posed_fountain, tmp_path: Path, monkeypatch
) -> None:
    """Without matches no photographs hang together: none is registered."""
    pytest.importorskip("pycolmap", reason="needs pycolmap")
    from deepdetect.evaluation.protocols import sfm_methods as module

    folder = write_posed_fountain(tmp_path / "fountain", ("0004", "0005", "0006"), 128)

    def nothing(stages, pairs):
        return {pair: np.empty((0, 2), np.int64) for pair in pairs}

    method = module.SfmMethod("nothing", module.find_sift, nothing)
    monkeypatch.setattr(sfm, "run_in_child", lambda function, task: function(task))
    from deepdetect.datasets.posed_images import load_posed_scenes

    chosen = choose_photographs(load_posed_scenes(folder)[0], 20)
    found = sfm.measure_scene(BenchmarkContext(folder), method, chosen)
    assert (len(found.given.views), len(found.estimated.views)) == (0, 0)
    assert found.agreement == ()
    assert found.memory > 1e7


@pytest.mark.slow
def test_a_whole_run_on_small_photographs(write_posed_fountain, tmp_path: Path) -> None:
    pytest.importorskip("pycolmap", reason="needs pycolmap")
    names = [f"{number:04}" for number in range(2, 8)]
    folder = write_posed_fountain(tmp_path / "fountain", names)
    options = BenchmarkOptions(DeepDetect())
    report = run_benchmarks(["sfm"], folder, options, cache=tmp_path / "cache")
    assert report.failures == ()
    report.save(tmp_path / "report")
    text = (tmp_path / "report" / "report.md").read_text("utf-8")
    assert "Dense points of two halves" in text
    assert {path.name for path in (tmp_path / "report" / "tables").iterdir()} == {
        *("sfm.csv", "sfm_cost.csv", "sfm_dense.csv", "sfm_photographs.csv")
    }
    tables = {table.key: table for table in report.tables()}
    given = {
        row["keypoints"]: row
        for row in (by_column(tables["sfm"], k) for k in range(len(tables["sfm"].rows)))
        if row["intrinsics"] == "true"
    }
    assert given[POINTS]["registered"] == given[SIFT]["registered"] == 6
    assert min(given[title]["AUC at 5°"] for title in (POINTS, SIFT)) > 0.9
    assert given[RANDOM]["AUC at 1°"] < given[POINTS]["AUC at 1°"]
    ours = by_column(tables["sfm_dense"], 0)
    assert ours["covered"] > 0.8
    assert ours["median distance, px"] < 0.5
    # The row is what the command gives.
    model = reconstruct_many(
        sorted(folder.glob("*.jpg")), tmp_path / "model", dense=False, workers=1
    )
    estimated = by_column(tables["sfm"], 1)
    assert (estimated["keypoints"], estimated["intrinsics"]) == (POINTS, "estimated")
    assert estimated["sparse points"] == pytest.approx(len(model.sparse), rel=0.02)
    # A second run finds all in the cache.
    again = run_benchmarks(["sfm"], folder, options, cache=tmp_path / "cache")
    assert again.metadata["results made, not found in the cache"] == "0"
    assert [table.rows for table in again.tables()] == [table.rows for table in report.tables()]
