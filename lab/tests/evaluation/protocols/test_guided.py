"""Unguided and guided counts beside each other, on pairs whose truth is known."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deepdetect import DeepDetect, match_images
from deepdetect_lab.datasets.planar import PlanarPair
from deepdetect_lab.evaluation.options import BenchmarkOptions
from deepdetect_lab.evaluation.protocols.guided import (
    SEEDS,
    guided_sections,
    match_guided,
)
from deepdetect_lab.evaluation.report import Section
from deepdetect_lab.evaluation.run import Run

MOVE = np.array([[1.0, 0.02, -6], [-0.01, 1, 4], [0, 0, 1]])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, write_scene) -> Path:
    root = tmp_path_factory.mktemp("guided")
    write_scene(root, (240, 200), MOVE, count=2)
    return root


@pytest.fixture(scope="module")
def pair(folder: Path) -> PlanarPair:
    return PlanarPair("scene", 2, folder / "img1.png", folder / "img2.png", MOVE)


@pytest.fixture(scope="module")
def options(edge_detector: DeepDetect) -> BenchmarkOptions:
    return BenchmarkOptions(edge_detector, ("guided",), ())


@pytest.fixture(scope="module")
def section(options: BenchmarkOptions, pair: PlanarPair) -> Section:
    run = Run(pair.first.parent)
    elsewhere = MOVE + [[0, 0, 40], [0, 0, 0], [0, 0, 0]]
    wrong = dataclasses.replace(pair, homography=elsewhere)
    (found,) = guided_sections(run, options, {"true": [pair], "wrong": [wrong]}, "key", "Scenes")
    assert not run.skipped
    return found


def rows(section, key: str) -> dict[str, dict[str, object]]:
    (table,) = [table for table in section.tables if table.key == key]
    return {row["method"]: row for row in table.rows}


@pytest.mark.slow
def test_both_ways_and_both_baselines_have_counts_and_precision(section) -> None:
    found = rows(section, "key_guided_true")
    assert len(found) == 3
    assert sum(name.startswith("baseline") for name in found) == 2
    for row in found.values():
        assert row["guided by"] == "homography"
        for way in ("descriptors alone", "guided"):
            assert row[f"{way}: correct"] > 0
            assert 0 < row[f"{way}: precision"] <= 1
        assert row["guided: unique"] <= row["guided: correct"] <= row["matchable"]
        assert row["guided: of the matchable"] == row["guided: correct"] / row["matchable"]
        assert 0 < row["lowest"] <= row["guided: of the matchable"]
        assert row["guided: corner error, px"] < 0.5


@pytest.mark.slow
def test_the_counts_are_those_of_match_images(
    section, options: BenchmarkOptions, pair: PlanarPair
) -> None:
    row = rows(section, "key_guided_true")["DeepDetect, threshold 0.5"]
    counts = []
    for seed in range(SEEDS):
        found = match_images(pair.first, pair.second, options.detector, seed=seed)
        mapped = np.c_[found.points0, np.ones(len(found))] @ MOVE.T
        gaps = np.linalg.norm(mapped[:, :2] / mapped[:, 2:] - found.points1, axis=1)
        counts.append(int((gaps < 1).sum()))
    assert row["guided: correct"] == sorted(counts)[SEEDS // 2]
    assert row["lowest"] == min(counts) / row["matchable"]


@pytest.mark.slow
def test_a_wrong_truth_finds_nothing_right(section) -> None:
    """The ground truth only evaluates: the matches are the same, and none of them is right."""
    true, wrong = rows(section, "key_guided_true"), rows(section, "key_guided_wrong")
    for name, row in wrong.items():
        assert row["guided: precision"] < 0.01
        assert row["guided: corner error, px"] == pytest.approx(40, abs=1)
        assert row["guided: seconds"] == true[name]["guided: seconds"]


@pytest.mark.slow
def test_unrelated_images_are_said_to_be_unguided(
    options: BenchmarkOptions, tmp_path: Path, write_scene
) -> None:
    write_scene(tmp_path, (100, 80), np.eye(3), count=2)
    noise = np.random.default_rng(0).integers(0, 256, (80, 100, 3), np.uint8)
    Image.fromarray(noise).save(tmp_path / "img2.png")
    pair = PlanarPair("none", 2, tmp_path / "img1.png", tmp_path / "img2.png", np.eye(3))
    run = Run(tmp_path)
    (found,) = guided_sections(run, options, {"true": [pair]}, "key", "None")
    for row in rows(found, "key_guided_true").values():
        assert row["guided by"] == "none"
        assert row["guided: corner error, px"] is None
        assert row["guided: seconds"] > 0
        assert row["descriptors alone: correct"] is not None
    given = match_images(pair.first, pair.second, options.detector)
    assert not given.success
    assert len(given) == len(match_guided(run, options.deepdetect_480(), pair, 0)["points0"]) == 0
