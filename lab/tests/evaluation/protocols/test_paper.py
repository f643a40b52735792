"""The paper's protocol with the published weights, beside what is known of the published system."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from deepdetect import DeepDetect
from deepdetect.detector.heatmap import HeatmapOptions
from deepdetect_lab.datasets.middlebury import load_calibrated_pair
from deepdetect_lab.datasets.planar import PlanarScene, load_oxford
from deepdetect_lab.evaluation.baselines.method import LocalFeature, deepdetect_feature
from deepdetect_lab.evaluation.baselines.opencv import (
    CLASSICAL,
    KD_TREES,
    self_described,
    with_kd_trees,
)
from deepdetect_lab.evaluation.options import BenchmarkOptions
from deepdetect_lab.evaluation.protocols import paper_numbers
from deepdetect_lab.evaluation.protocols.paper import (
    OXFORD_PAIRS,
    correct_matches,
    density_table,
    repeatability_table,
)
from deepdetect_lab.evaluation.protocols.paper_numbers import (
    DENSITY,
    FIGURE_8,
    NUMBERS,
    paper_title,
)
from deepdetect_lab.evaluation.protocols.planar import select_pairs
from deepdetect_lab.evaluation.protocols.stereo_pipelines import paper_points
from deepdetect_lab.evaluation.run import Run

DENSITIES = {0.5: 0.525, 0.7: 0.486, 0.8: 0.462, 0.9: 0.431}
REPEATABILITIES = {
    **{"graf": 0.898, "wall": 0.988, "bikes": 0.945},
    **{"leuven": 1.0, "trees": 0.950, "ubc": 0.899},
}
NOTEBOOK_MATCHES_OF_SIFT = (52, 163_510)
"""Correct and all of wall 1-6 with low settings, that the authors' notebooks print."""

NOTEBOOK_KEYPOINTS = {"DeepDetect": (605_433, 477_060), "SIFT, low settings": (184_084, 118_628)}
"""The keypoints of both images of wall 1-6 that the authors' notebooks print."""

CORRECT = {"bikes 1-6": 16_447, "leuven 1-6": 58_946, "ubc 1-6": 39_891}
"""The scenes whose matching takes seconds; wall and trees take a minute each."""


@pytest.fixture(scope="module")
def weights(published: Callable[[str], Path]) -> DeepDetect:
    return DeepDetect(published("matching"))


@pytest.fixture(scope="module")
def scenes(shared: Path) -> list[PlanarScene]:
    every = load_oxford(shared / "data" / "oxford")
    return [scene for scene in every if scene.name in REPEATABILITIES]


@pytest.fixture(scope="module")
def run(shared: Path) -> Run:
    return Run(shared / "data")


@pytest.mark.slow
def test_densities(run: Run, weights: DeepDetect, scenes: list[PlanarScene]) -> None:
    options = BenchmarkOptions(weights, channels="rgb")
    features = [options.deepdetect_480(threshold) for threshold in DENSITIES]
    table = density_table(run, features, scenes, "density")
    for row, expected in zip(table.rows, DENSITIES.values(), strict=True):
        assert row["mean"] == pytest.approx(expected, abs=0.005)


@pytest.mark.slow
def test_repeatability(run: Run, weights: DeepDetect, scenes: list[PlanarScene]) -> None:
    options = BenchmarkOptions(weights, channels="bgr")
    features = [options.deepdetect_480()]
    table = repeatability_table(run, features, scenes, "repeatability")
    found = {scene.name: table.rows[0][scene.name] for scene in scenes}
    assert found == pytest.approx(REPEATABILITIES, abs=0.01)


@pytest.mark.slow
def test_matches(run: Run, weights: DeepDetect, scenes: list[PlanarScene], shared: Path) -> None:
    options = BenchmarkOptions(weights, channels="bgr")
    every = select_pairs(load_oxford(shared / "data" / "oxford"), OXFORD_PAIRS)
    feature = options.deepdetect_480()
    found = {
        pair.name: correct_matches(run, feature, pair)[0] for pair in every if pair.name in CORRECT
    }
    assert found == pytest.approx(CORRECT, rel=0.05)


def _keypoints_of_wall(run: Run, method: LocalFeature, shared: Path) -> tuple[int, ...]:
    scenes = load_oxford(shared / "data" / "oxford")
    (pair,) = select_pairs(scenes, [("wall", 6)])
    images = (pair.first, pair.second)
    return tuple(len(run.keypoints(method, image)[0]) for image in images)


@pytest.mark.slow
def test_keypoints_of_wall(run: Run, weights: DeepDetect, shared: Path) -> None:
    """By the network, whose float32 sums differ from those of the authors' GPU."""
    own = BenchmarkOptions(weights, channels="bgr").deepdetect_480()
    found = _keypoints_of_wall(run, own, shared)
    assert found == pytest.approx(NOTEBOOK_KEYPOINTS["DeepDetect"], rel=1e-4)


@pytest.mark.slow
def test_sift_low_on_wall_as_in_the_notebook(run: Run, shared: Path) -> None:
    feature = CLASSICAL["sift-low"]
    found = _keypoints_of_wall(run, feature, shared)
    assert found == NOTEBOOK_KEYPOINTS["SIFT, low settings"]
    (pair,) = select_pairs(load_oxford(shared / "data" / "oxford"), [("wall", 6)])
    correct, matches = correct_matches(run, feature, pair)
    expected, of_all = NOTEBOOK_MATCHES_OF_SIFT
    assert correct == pytest.approx(expected, rel=0.15)
    assert matches == pytest.approx(of_all, rel=0.001)


@pytest.mark.slow
def test_voxels_of_cones(shared: Path, published: Callable[[str], Path]) -> None:
    """The paper's 49,979, with its second weights, within 0.3 %: the median of three draws.

    About 49,950 matches lie on one row. A draw of RANSAC counts these, or, with seed 0, 50,431: an
    essential matrix that is not quite that of a rectified pair explains 1 % more. Which of them it
    is depends on the order of the matches, and so on each of the network's roundings.
    """
    scene = load_calibrated_pair(shared / "data" / "middlebury" / "cones")
    detector = DeepDetect(published("reconstruction")).configured(HeatmapOptions(480, "bgr"))
    feature = deepdetect_feature(detector)
    counts = [len(paper_points(feature, scene, seed)[0]) for seed in range(3)]
    assert np.median(counts) == pytest.approx(FIGURE_8["DeepDetect"]["cones"], rel=0.003)


@pytest.mark.slow
def test_voxels_of_cones_by_sift(shared: Path) -> None:
    """The paper prints 14,128 for SIFT with low settings, by an older OpenCV."""
    scene = load_calibrated_pair(shared / "data" / "middlebury" / "cones")
    points, _ = paper_points(self_described("sift-low"), scene)
    assert len(points) == pytest.approx(FIGURE_8["SIFT, low settings"]["cones"], rel=0.05)


def test_the_numbers_are_those_that_the_paper_prints(shared: Path) -> None:
    printed = json.loads((shared / "reference" / "paper_tables.json").read_text())
    titles = {"DeepDetect": "DeepDetect, threshold 0.5"}
    for method in ("SIFT", "ORB", "BRISK", "FAST", "AGAST", "Harris", "Shi-Tomasi"):
        titles |= {method: method, f"{method} (low)": f"{method}, low settings"}
    titles["SIFT (default)"] = "SIFT"

    def named(table: str, columns: dict[str, str] = titles) -> dict[str, dict[str, float]]:
        names = [columns.get(name, name) for name in printed[table].pop("columns")]
        rows = printed[table].items()
        return {name: {pair: row[k] for pair, row in rows} for k, name in enumerate(names)}

    table_1 = printed["table_1"]
    del table_1["columns"]
    assert {titles.get(n, n): row for n, row in table_1.items()} == NUMBERS["table_1"]
    kd_trees = {f"{m} (low)": f"{m}, low settings, {KD_TREES}" for m in ("ORB", "BRISK")}
    assert named("table_2_correct_matches", titles | kd_trees) == paper_numbers.MATCHES
    assert named("figure_6_correct_matches") == paper_numbers.FIGURE_6
    own_title = titles | {"DeepDetect": "DeepDetect"}
    assert named("figure_8_points", own_title) == FIGURE_8
    table_3 = printed["table_3_repeatability"]
    for place, kind in (("57 illumination", "illumination"), ("59 viewpoint", "viewpoint")):
        for method, value in table_3.pop(f"HPatches, {place} scenes").items():
            found = paper_numbers.HPATCHES_REPEATABILITY[titles.get(method, method)]
            assert found[kind] == value
    expected = {
        titles.get(m, m): {s: row[m] for s, row in table_3.items()} for m in table_3["graf"]
    }
    headline = printed["headline"]
    expected[titles["DeepDetect"]]["mean"] = headline["mean_repeatability_oxford"]
    assert expected == paper_numbers.OXFORD_REPEATABILITY
    assert headline["mean_density_oxford"] == DENSITY[titles["DeepDetect"]]
    assert headline["most_correct_matches_hpatches"] == NUMBERS["max_matches"]
    assert headline["most_points_stereo"] == FIGURE_8["DeepDetect"]["cloth"]


@pytest.mark.slow
@pytest.mark.parametrize("name", CLASSICAL)
def test_classical_densities_are_the_papers_without_trees(name: str, shared: Path) -> None:
    """To all four digits."""
    run, feature = Run(shared / "data"), CLASSICAL[name]
    scenes = load_oxford(shared / "data" / "oxford")
    row = density_table(run, [feature], scenes, "density", with_paper=True).rows[0]
    title = "mean without trees"
    assert f"{row[title]:.4f}" == f"{DENSITY[feature.title]:.4f}"
    assert row[paper_title(title)] == DENSITY[feature.title]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "brisk", "orb"), [("leuven", 3163, 3582), ("bikes", 358, 577), ("ubc", 464, 977)]
)
def test_kd_trees_over_bytes_give_the_papers_matches(
    scene: str, brisk: int, orb: int, shared: Path
) -> None:
    pairs = select_pairs(load_oxford(shared / "data" / "oxford"), [(scene, 6)])
    features = with_kd_trees([CLASSICAL["brisk-low"], CLASSICAL["orb-low"]])[1::2]
    found = [correct_matches(Run(Path()), f, pairs[0])[0] for f in features]
    assert found == pytest.approx([brisk, orb], rel=0.06)
