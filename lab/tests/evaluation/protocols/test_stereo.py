"""The stereo benchmark on a corner of cones, beside the truth and beside known answers."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from deepdetect import DeepDetect
from deepdetect.io.image import luma
from deepdetect_lab.datasets.middlebury import StereoPair, load_calibrated_pair, load_middlebury
from deepdetect_lab.evaluation.baselines.opencv import self_described
from deepdetect_lab.evaluation.masks import LabelDetector
from deepdetect_lab.evaluation.options import BenchmarkOptions
from deepdetect_lab.evaluation.protocols.stereo import (
    AS_IT_IS,
    SHIFTED,
    ground_truths,
    middlebury,
    shift_view,
)
from deepdetect_lab.evaluation.protocols.stereo_matches import score_stereo_matches
from deepdetect_lab.evaluation.protocols.stereo_pipelines import (
    paper_points,
    pipelines,
    sgbm_disparity,
)
from deepdetect_lab.evaluation.report import Section
from deepdetect_lab.evaluation.run import Run

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
    run = Run(data, tmp_path_factory.mktemp("cache"))
    (found,) = middlebury(run, options)
    (again,) = middlebury(run, options)
    assert str(again.tables) == str(found.tables)
    assert run.made == 2 * len(pipelines(options))
    assert not run.skipped
    return found


def rows(section: Section, key: str) -> dict[str, dict[str, object]]:
    (table,) = [table for table in section.tables if table.key == key]
    return {row["pipeline"]: row for row in table.values()}


@pytest.mark.slow
def test_ours_is_exact_and_the_baselines_are_there(section: Section) -> None:
    found = rows(section, "middlebury_cones")
    assert all(row["seconds"] > 0 and row["all, MB"] >= 0 for row in found.values())
    ours = found["ours, weights dense"]
    assert ours["points"] > 8_000
    assert ours["1 - bad-1"] > 0.97
    assert ours["1 - bad-2"] > 0.985
    assert ours["of them filled"] == 0
    every = found["all pixels, --density 1"]
    assert every["completeness at 1 px"] > found["baseline: all pixels"]["completeness at 1 px"]
    assert every["of them filled"] > 0
    assert found["baseline: all pixels"]["points"] > ours["points"]
    random = found["baseline: as many random pixels as ours"]
    assert random["points"] == pytest.approx(ours["points"], rel=0.3)
    assert found["OpenCV's SGBM"]["completeness at 1 px"] > 0.6
    assert found["SIFT, low settings"]["points"] > found["SIFT"]["points"]
    published = found["the paper's pipeline, weights dense"]
    assert published["points, in the paper"] == 49_979
    assert [each.key for each in section.figures] == ["figure8_cones", "figure8_nothing-known"]
    assert f"ours {ours['points']:,}" in section.figures[0].title
    drawn = cv2.imdecode(np.frombuffer(section.figures[0].png, np.uint8), cv2.IMREAD_COLOR)
    assert drawn.std() > 20


@pytest.mark.slow
def test_without_a_truth_nothing_is_evaluated(section: Section) -> None:
    known, blank = (rows(section, f"middlebury_{s}") for s in ("cones", "nothing-known"))
    for name, row in blank.items():
        assert row["1 - bad-1"] is None
        assert row["F-score"] is None
        if name.startswith(("ours", "all", "baseline: all", "OpenCV")):
            assert row["points"] == known[name]["points"]


def test_sgbm_finds_a_shift() -> None:
    texture = np.random.default_rng(0).integers(0, 256, (60, 120, 3), np.uint8)
    texture = cv2.GaussianBlur(texture, (0, 0), 1)
    disparity = sgbm_disparity(texture[:, :110], texture[:, 9:119], 16, (16, 0))
    found = disparity[np.isfinite(disparity)]
    assert (np.abs(found - 9) < 0.5).mean() > 0.98
    assert len(found) > 0.9 * 60 * 101


def test_the_papers_pipeline_keeps_what_lies_on_a_row(data: Path) -> None:
    scene = load_calibrated_pair(data / "middlebury" / "cones")
    points0, points1 = paper_points(self_described("sift-low"), scene)
    assert len(points0) == len(points1) > 1_000
    assert (np.abs(points0[:, 1] - points1[:, 1]) <= 1).mean() > 0.98


@pytest.mark.slow
def test_the_truth_of_dolls_is_shifted_by_two_baselines(shared: Path) -> None:
    """Shifted, it says of places that look alike that they are the same."""

    def photometric_error(disparity: np.ndarray) -> float:
        left, right = (luma(image).astype(np.float32) for image in (pair.left, pair.right))
        rows, columns = np.nonzero(np.isfinite(disparity))
        other = np.rint(columns - disparity[rows, columns]).astype(int)
        inside = (other >= 0) & (other < left.shape[1])
        rows, columns, other = rows[inside], columns[inside], other[inside]
        return float(np.abs(left[rows, columns] - right[rows, other]).mean())

    folder = shared / "data" / "middlebury"
    assert list(ground_truths(folder / "cones")) == [AS_IT_IS]
    found = ground_truths(folder / "dolls")
    assert list(found) == [AS_IT_IS, SHIFTED]
    pair = load_middlebury(folder / "dolls")
    assert photometric_error(found[SHIFTED]) < 0.7 * photometric_error(found[AS_IT_IS])


def test_the_nearest_place_hides_the_others() -> None:
    row = np.array([[np.nan, 0.0, 0.0, 2.0, 1.0]])
    np.testing.assert_array_equal(shift_view(row, 1), [[np.nan, 2.0, 0.0, 1.0, np.nan]])
    np.testing.assert_array_equal(shift_view(row, 0), row)


@pytest.fixture
def shifted_pair(photo: np.ndarray) -> StereoPair:
    """A photograph and itself, moved by 6 pixels: the truth is exact."""
    left, right = photo[:100, :194], photo[:100, 6:200]
    return StereoPair("moved", left, right, np.full(left.shape[:2], 6.0, np.float32))


@pytest.mark.slow
def test_each_source_is_beside_its_chance_level(shifted_pair: StereoPair) -> None:
    pair = shifted_pair
    rows = score_stereo_matches({"labels": LabelDetector()}, [pair, pair])
    sources = ("labels", "random, as labels", "all pixels")
    assert [row["source"] for row in rows] == [source for source in sources for _ in range(2)]
    labels, _, chance, _, every, _ = rows
    assert chance["density"] == pytest.approx(labels["density"], abs=0.001)
    assert every["density"] == 1
    assert labels["precision"] > 0.9
    assert chance["precision"] < labels["precision"]
    assert labels["evaluated"] == labels["matches"]
    wrong = StereoPair(pair.name, pair.left, pair.right, pair.disparity + 3)
    found = score_stereo_matches({"labels": LabelDetector()}, [wrong])
    assert found[0]["precision"] < 0.1
    assert found[0]["matches"] == labels["matches"]
