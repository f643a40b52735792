"""The tables of reconstructions of many photographs, and a whole run on small ones."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from deepdetect import DeepDetect, reconstruct_many
from deepdetect.geometry.camera import Camera, PosedView
from deepdetect.sfm import MultiViewOptions
from deepdetect_lab.datasets.posed_images import (
    PosedImage,
    PosedPair,
    PosedScene,
    load_posed_scenes,
)
from deepdetect_lab.evaluation.benchmarks import run_benchmarks
from deepdetect_lab.evaluation.options import BenchmarkOptions
from deepdetect_lab.evaluation.protocols import sfm
from deepdetect_lab.evaluation.protocols.sfm import camera_table, choose_images
from deepdetect_lab.evaluation.run import Run

POINTS, RANDOM = "DeepDetect, points", "baseline: as many random points"
SIFT, REFINED = "SIFT, pycolmap", "SIFT, tracks refined"
DENSE = "DeepDetect, dense tracks"


def model(views: dict, points=0, track_length=float("nan"), error=float("nan")):
    values = views, points, track_length, error
    return dict(zip(("views", *sfm.MODEL_COLUMNS), values, strict=True))


NOTHING = model({})


def images(folder: Path, count: int) -> tuple[PosedImage, ...]:
    """Cameras on an arc with radius 10; all have one file."""
    found = []
    for number in range(count):
        path = folder / f"{number:06}.png"
        if not path.exists():
            cv2.imwrite(str(path), np.zeros((48, 64), np.uint8))
        rotation = cv2.Rodrigues(np.array([0.02 * number**2, 0.1 * number, 0]))[0]
        camera = Camera((64, 48), 50)
        found.append(PosedImage(path.name, camera, rotation, np.array([0.0, 0, 10]), path))
    return tuple(found)


@pytest.fixture
def scene(tmp_path: Path) -> PosedScene:
    return PosedScene("arc", images(tmp_path, 5), ())


@pytest.fixture
def rows(scene: PosedScene) -> list:
    # Twice as large, in another frame, and one is missing.
    turn = cv2.Rodrigues(np.array([0.5, -1, 0.2]))[0]
    own = {
        view.name: PosedView(
            view.name, view.camera, view.rotation @ turn.T, -view.rotation @ turn.T @ (2 * turn @ c)
        )
        for view in scene.images[:4]
        for c in (view.centre,)
    }
    good = model(own, 1000, 3.5, 0.25)
    return [
        {"scene": scene, "method": POINTS, "true": good, "estimated": NOTHING},
        {"scene": scene, "method": RANDOM, "true": NOTHING, "estimated": NOTHING},
    ]


def test_cameras_are_compared_after_the_alignment(rows: list) -> None:
    table = camera_table(rows)
    assert [list(row.values())[1:5] for row in table.rows] == [
        [POINTS, "true", 5, 4],
        [POINTS, "estimated", 5, 0],
        [RANDOM, "true", 5, 0],
        [RANDOM, "estimated", 5, 0],
    ]
    ours = table.rows[0]
    # 6 of 10 pairs are exact, the others have no pose.
    for threshold in ("0.5", "1", "5"):
        assert ours[f"AUC at {threshold}°"] == pytest.approx(0.6, abs=0.01)
    assert ours["centres, unit of the truth"] == pytest.approx(0, abs=1e-9)
    assert ours["rotations, °"] == pytest.approx(0, abs=1e-4)
    assert (ours["sparse points"], ours["track length"]) == (1000, 3.5)
    nothing = table.values()[2]
    assert nothing["AUC at 5°"] == 0
    assert nothing["centres, unit of the truth"] is nothing["rotations, °"] is None


def test_models_are_compared_with_the_first_in_the_unit_of_the_truth(
    scene: PosedScene, rows: list
) -> None:
    first = rows[0]["true"]
    half = {  # in a unit of its own, and one camera is 0.03 of the truth's aside
        name: PosedView(
            name, view.camera, view.rotation, -view.rotation @ (0.5 * view.centre + [move, 0, 0])
        )
        for (name, view), move in zip(first["views"].items(), (0.03, 0, 0, 0), strict=True)
    }
    other = model(half, 1, 2.0, 0.1)
    rows.insert(1, {"scene": scene, "method": SIFT, "true": other, "estimated": first})
    column = "from the first row's, unit of the truth"
    lines = camera_table(rows).rows
    values = [row.get(column) for row in lines]
    assert values[0] is values[1] is values[3] is values[4] is None
    assert 0.005 < values[2] < 0.03


def test_images_of_a_sequence_are_its_first(tmp_path: Path) -> None:
    all_images = images(tmp_path, 9)
    pair = all_images[0], all_images[1]
    sequence = PosedScene("clip", all_images, (PosedPair("clip", *pair, 1),))
    unordered = PosedScene("set", all_images, (PosedPair("set", *pair),))
    stems = [[int(i.path.stem) for i in choose_images(s, 5).images] for s in (sequence, unordered)]
    assert stems == [[0, 1, 2, 3, 4], [0, 2, 4, 6, 8]]
    assert len(choose_images(unordered, 20).images) == 9


def test_what_cannot_be_reconstructed_is_a_result(
    write_posed_fountain, tmp_path: Path, monkeypatch
) -> None:
    """Without matches no images hang together: none is registered."""
    folder = write_posed_fountain(tmp_path / "fountain", ("0004", "0005", "0006"), 128)

    def nothing(stages, pairs):
        return {pair: np.empty((0, 2), np.int64) for pair in pairs}

    unmatched = sfm.SfmMethod("nothing", sfm.find_sift, nothing)
    monkeypatch.setattr(sfm, "run_in_child", lambda function, *given: function(*given))
    chosen = choose_images(load_posed_scenes(folder)[0], 20)
    found = sfm.measure_scene(Run(folder), unmatched, chosen)
    assert found["true"]["views"] == found["estimated"]["views"] == {}
    assert found["memory, MB"] > 10


@pytest.mark.slow
def test_a_whole_run_on_small_images(write_posed_fountain, tmp_path: Path) -> None:
    names = [f"{number:04}" for number in range(2, 8)]
    folder = write_posed_fountain(tmp_path / "fountain", names)
    options = BenchmarkOptions(DeepDetect())
    report = run_benchmarks(["sfm"], folder, options, cache=tmp_path / "cache")
    assert report.failures == ()
    cameras, costs, dense = report.tables()
    points, sgbm = dense.rows
    assert 0.1 < sgbm["share, own map"] < 1
    assert 0.1 < points["share, own map"] < points["share, all maps"] < 1
    assert points["halves: share apart"] < 0.1
    assert all(cost > 0 for row in costs.values() for cost in [*row.values()][2:])
    lines = [*cameras.values()]
    given = {row["keypoints"]: row for row in lines if row["intrinsics"] == "true"}
    assert given[POINTS]["registered"] == given[SIFT]["registered"] == 6
    assert min(given[title]["AUC at 5°"] for title in (POINTS, SIFT)) > 0.9
    seen = {name: row["sparse points"] * row["track length"] for name, row in given.items()}
    assert seen[RANDOM] < 0.6 * seen[POINTS]
    # The row is what the command gives.
    whole = reconstruct_many(
        sorted(folder.glob("*.jpg")),
        tmp_path / "model",
        options=MultiViewOptions(dense=False),
        workers=1,
    )
    assert (lines[1]["keypoints"], lines[1]["intrinsics"]) == (POINTS, "estimated")
    assert lines[1]["sparse points"] == pytest.approx(len(whole.sparse), rel=0.02)
    # A second run finds all in the cache.
    again = run_benchmarks(["sfm"], folder, options, cache=tmp_path / "cache")
    assert again.metadata["results computed, not read from the cache"] == "0"
    assert str(again.sections) == str(report.sections)
