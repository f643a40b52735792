"""Dark and blurred copies of a small scene, and what is left of the score in daylight."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from deepdetect.features.keypoints import Keypoints
from deepdetect.io.image import load_image
from deepdetect_lab.datasets.degradation import DEGRADATIONS, degrade
from deepdetect_lab.datasets.planar import PlanarPair, load_low_visibility
from deepdetect_lab.evaluation.baselines.method import BaselineError, with_common_descriptor
from deepdetect_lab.evaluation.baselines.opencv import CLASSICAL
from deepdetect_lab.evaluation.metrics import repeatability
from deepdetect_lab.evaluation.protocols import degraded
from deepdetect_lab.evaluation.protocols.degraded import (
    BUDGETS,
    degraded_copy,
    degraded_pair,
    degraded_rows,
    degraded_tables,
)
from deepdetect_lab.evaluation.protocols.standard import pair_row
from deepdetect_lab.evaluation.run import Run

FAST = with_common_descriptor(CLASSICAL["fast-low"])


@pytest.fixture(scope="module", autouse=True)
def few_random_points():
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(repeatability, "CHANCE_POINTS", 200)
        yield


@pytest.fixture(scope="module")
def pairs(low_visibility_folder: Path) -> list[PlanarPair]:
    return [pair for s in load_low_visibility(low_visibility_folder) for pair in s.pairs]


def test_a_copy_is_made_once_and_outside_the_data(pairs: list[PlanarPair], tmp_path: Path) -> None:
    image, one = pairs[0].second, DEGRADATIONS["dark-8"]
    before = sorted(image.parent.iterdir())
    path = degraded_copy(image, one, tmp_path)
    assert path.is_relative_to(tmp_path)
    assert sorted(image.parent.iterdir()) == before
    np.testing.assert_array_equal(load_image(path), degrade(load_image(image), one))
    made = path.stat().st_mtime_ns
    assert degraded_copy(image, one, tmp_path) == path
    assert path.stat().st_mtime_ns == made
    newer = degraded_copy(image, dataclasses.replace(one, version=2), tmp_path)
    assert newer != path
    pair = degraded_pair(pairs[0], one, tmp_path)
    assert (pair.first, pair.second) == (pairs[0].first, path)
    assert pair.homography is pairs[0].homography


def test_tables_have_scores_and_their_fraction_of_daylight(
    pairs: list[PlanarPair], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lights = {name: DEGRADATIONS[name] for name in ("dark-8", "blur-2")}
    monkeypatch.setattr(degraded, "DEGRADATIONS", lights)
    run = Run(tmp_path, tmp_path / "cache")
    rows = degraded_rows(run, [FAST], pairs)
    made = run.made
    assert len(rows) == len(lights) * len(pairs)
    overview, *tables = degraded_tables([FAST], rows, "key", "pairs")
    assert [table.key for table in tables] == [f"key_{name}" for name in lights]
    daylight = [pair_row(run, FAST, pair, BUDGETS) for pair in pairs]
    for table, one in zip(tables, lights.values(), strict=True):
        (row,) = table.rows
        dark = [degraded_pair(pair, one, run.files_folder) for pair in pairs]
        scores = [pair_row(run, FAST, pair, BUDGETS) for pair in dark], daylight
        now, then = (np.mean([p["repeated", 512, 1.0] for p in two]) for two in scores)
        assert row["@1 px, 512"] == pytest.approx(now)
        assert row["@1 px, 512: of daylight"] == pytest.approx(now / then)
        assert 0 < now < then
        assert row["@3 px, 8,192"] is None, "small images do not fill it"
        correct = [np.mean([p["correct", 1] for p in two]) for two in scores]
        assert row["correct at 1 px, 2,048"] == pytest.approx(correct[0])
        assert row["correct at 1 px, 2,048: of daylight"] == pytest.approx(correct[0] / correct[1])
        left = overview.rows[0][f"{one.title}: correct at 1 px"]
        assert left == row["correct at 1 px, 2,048: of daylight"]
    assert run.made == made, "all of it is cached"


def test_pairs_that_could_not_be_measured_in_both_ways_are_left_out(
    pairs: list[PlanarPair], tmp_path: Path
) -> None:
    bad = load_image(pairs[1].second)

    def detect(rgb: np.ndarray) -> Keypoints:
        if np.array_equal(rgb, bad):
            raise BaselineError("not this one")
        return CLASSICAL["fast"].detect(rgb)

    feature = dataclasses.replace(FAST, detect=detect, detection="fails")
    run = Run(tmp_path)
    rows = degraded_rows(run, [feature], pairs)
    assert {row["pair"] for row in rows} == {"dusty 1-2"}
    assert len(run.failures) == 1
    tables = {table.key: table for table in degraded_tables([feature], rows, "key", "pairs")}
    assert tables["key_dark-8"].rows[0]["pairs"] == 1
    assert run.files_folder.is_dir(), "without a cache the copies are in a temporary folder"
