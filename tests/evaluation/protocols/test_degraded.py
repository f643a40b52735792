"""Dark and blurred copies of a small scene, and what is left of the score in daylight."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from deepdetect import DeepDetect, OptionError
from deepdetect.datasets.degradation import DEGRADATIONS, degrade
from deepdetect.datasets.low_visibility import load_low_visibility
from deepdetect.datasets.types import PlanarPair
from deepdetect.evaluation.baselines.method import with_common_descriptor
from deepdetect.evaluation.baselines.opencv import CLASSICAL
from deepdetect.evaluation.cache import StageCache
from deepdetect.evaluation.context import BenchmarkContext
from deepdetect.evaluation.metrics import repeatability
from deepdetect.evaluation.options import BenchmarkOptions
from deepdetect.evaluation.planar_benchmarks import plan_oxford
from deepdetect.evaluation.protocols.degraded import (
    DEGRADED_BUDGETS,
    degraded_copy,
    degraded_pair,
    degraded_part,
)
from deepdetect.evaluation.protocols.standard import measure_pair
from deepdetect.evaluation.report import Table
from deepdetect.io.image import load_image

FAST = with_common_descriptor(CLASSICAL["fast-low"])


@pytest.fixture(scope="module", autouse=True)
def few_random_points():
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(repeatability, "CHANCE_POINTS", 200)
        yield


@pytest.fixture(scope="module")
def pairs(low_visibility_folder: Path) -> list[PlanarPair]:
    return [pair for s in load_low_visibility(low_visibility_folder) for pair in s.pairs()]


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


def test_the_second_image_or_both_are_degraded_and_the_truth_stays(
    pairs: list[PlanarPair], tmp_path: Path
) -> None:
    for images in ("second", "both"):
        found = degraded_pair(pairs[1], DEGRADATIONS["blur-2"], tmp_path, images)
        assert found.homography is pairs[1].homography
        assert (found.name, found.scene) == (pairs[1].name, pairs[1].scene)
        assert found.second != pairs[1].second
        assert (found.first == pairs[1].first) is (images == "second")


def test_tables_have_scores_and_their_fraction_of_daylight(
    pairs: list[PlanarPair], tmp_path: Path
) -> None:
    context = BenchmarkContext(tmp_path, StageCache(tmp_path / "cache"))
    part = degraded_part(context, [FAST], pairs, "key", "pairs")
    assert len(part.tasks) == (1 + len(DEGRADATIONS)) * len(pairs)
    found = {key: task.run() for key, task in part.tasks.items()}
    overview, *tables = part.summarize(found)
    assert [table.key for table in tables] == [f"key_{name}" for name in DEGRADATIONS]
    for table, one in zip(tables, DEGRADATIONS.values(), strict=True):
        assert isinstance(table, Table)
        row = dict(zip([c.title for c in table.columns], table.rows[0], strict=True))
        dark = [degraded_pair(pair, one, context.files_folder()) for pair in pairs]
        scores = [
            [measure_pair(context, FAST, pair, DEGRADED_BUDGETS) for pair in chosen]
            for chosen in (dark, pairs)
        ]
        now, then = (np.mean([p.repeatability[512][0].value for p in two]) for two in scores)
        assert row["@1 px, 512"] == pytest.approx(now)
        assert row["@1 px, 512: of daylight"] == pytest.approx(now / then)
        assert 0 < now < then
        assert row["@3 px, 8,192"] is None, "small images do not fill it"
        correct = [np.mean([p.matches.correct[0] for p in two]) for two in scores]
        assert row["correct at 1 px, 2,048"] == pytest.approx(correct[0])
        assert row["correct at 1 px, 2,048: of daylight"] == pytest.approx(correct[0] / correct[1])
        place = [c.title for c in overview.columns].index(f"{one.title}: correct at 1 px")
        assert overview.rows[0][place] == row["correct at 1 px, 2,048: of daylight"]
    made = context.cache.made
    for task in part.tasks.values():
        task.run()
    assert context.cache.made == made, "all of it is cached"


def test_pairs_that_could_not_be_measured_in_both_ways_are_left_out(
    pairs: list[PlanarPair], tmp_path: Path
) -> None:
    context = BenchmarkContext(tmp_path)
    part = degraded_part(context, [FAST], pairs, "key", "pairs")
    found = {
        key: task.run()
        for key, task in part.tasks.items()
        if key[1] in ("dusty 1-2, daylight", "dusty 1-2, dark-4", "smoky 1-2, dark-4")
    }
    tables = {table.key: table for table in part.summarize(found)}
    assert tables["key_dark-4"].rows[0][1] == 1
    assert tables["key_dark-8"].rows[0][1] == 0
    assert set(tables["key_dark-8"].rows[0][2:]) == {None}
    assert context.files_folder().is_dir(), "without a cache the copies are in a temporary folder"


def test_it_is_a_section_of_its_own_when_asked_for(
    oxford_folder: Path, edge_detector: DeepDetect
) -> None:
    options = BenchmarkOptions(edge_detector, classical=("fast",))
    assert "degraded" not in options.protocols
    asked = dataclasses.replace(options, protocols=("degraded",), degraded_images="both")
    (plan,) = plan_oxford(BenchmarkContext(oxford_folder), asked)
    assert plan.title == "Oxford, published homographies, dark and blurred"
    assert len(plan) == len(options.standard_features()) * 40 * (1 + len(DEGRADATIONS))
    assert "Both images" in plan.text[1]
    with pytest.raises(OptionError, match="did you mean 'second'"):
        dataclasses.replace(options, degraded_images="secondd")
