from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from deepdetect import DeepDetect
from deepdetect.datasets.low_visibility import load_low_visibility
from deepdetect.datasets.types import PlanarPair
from deepdetect.evaluation.baselines.method import (
    BaselineError,
    LocalFeature,
    with_common_descriptor,
)
from deepdetect.evaluation.baselines.opencv import CLASSICAL
from deepdetect.evaluation.baselines.random import random_feature
from deepdetect.evaluation.cache import StageCache
from deepdetect.evaluation.context import BenchmarkContext
from deepdetect.evaluation.metrics import repeatability
from deepdetect.evaluation.metrics.repeatability import mutual_nn_repeatability
from deepdetect.evaluation.options import BenchmarkOptions
from deepdetect.evaluation.protocols import standard_figures
from deepdetect.evaluation.protocols.standard import measure_pair, standard_part
from deepdetect.evaluation.protocols.standard_results import BUDGETS, FeatureResult, PairResult
from deepdetect.evaluation.protocols.standard_tables import (
    homography_table,
    kind_table,
    matching_table,
)
from deepdetect.evaluation.report import Report, Table
from deepdetect.evaluation.runner import run_benchmarks
from deepdetect.features.keypoints import Keypoints
from deepdetect.io.image import load_image

FAST = with_common_descriptor(CLASSICAL["fast"])


@pytest.fixture(scope="module")
def pairs(low_visibility_folder: Path) -> list[PlanarPair]:
    return [pair for s in load_low_visibility(low_visibility_folder) for pair in s.pairs()]


@pytest.fixture(scope="module", autouse=True)
def few_random_points():
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(repeatability, "CHANCE_POINTS", 1000)
        yield


def measure(
    context: BenchmarkContext,
    feature: LocalFeature,
    pairs: list[PlanarPair],
    budgets: tuple[int | None, ...],
) -> FeatureResult:
    return FeatureResult(feature, [measure_pair(context, feature, pair, budgets) for pair in pairs])


def test_budgets_repeatability_and_coverage_are_those_of_the_best_points(
    pairs: list[PlanarPair], tmp_path: Path
) -> None:
    context = BenchmarkContext(tmp_path, StageCache(tmp_path / "cache"))
    method = with_common_descriptor(CLASSICAL["fast-low"])
    result = measure(context, method, pairs, (64, None))
    for index, pair in enumerate(pairs):
        for budget in (64, None):
            points = []
            for path in (pair.first, pair.second):
                features = context.keypoints(method, path).features
                assert len(np.unique(features.xy, axis=0)) == len(features)
                points.append(features.best(budget or len(features)).xy)
            expected = mutual_nn_repeatability(*points, np.eye(3), ((80, 64), (80, 64)))
            found = result.pairs[index].repeatability[budget]
            assert [e.radius_px for e in found] == [1, 2, 3]
            for one, other in zip(found, expected, strict=True):
                assert (one.repeated, one.fewest) == (other.repeated, other.fewest)
                assert one.localization_px == pytest.approx(other.localization_px, nan_ok=True)
                assert one.chance == pytest.approx(other.chance, abs=1e-12)
            cells = {(int(x + 0.5) // 32, int(y + 0.5) // 32) for x, y in points[0]}
            assert result.pairs[index].coverage[budget] == pytest.approx(len(cells) / 6)
    assert result.pairs[0].repeatability[64][0].fewest == 64


def test_of_equal_images_all_is_repeated_and_the_homography_exact(
    pairs: list[PlanarPair], tmp_path: Path
) -> None:
    result = measure(BenchmarkContext(tmp_path), FAST, pairs[:1], (512,))
    (found,) = result.pairs
    assert [(e.value, e.localization_px) for e in found.repeatability[512]] == [(1, 0)] * 3
    assert found.matches.matches == found.matches.correct[0] > 10
    assert found.all_matches.matches >= found.matches.matches
    assert len(found.corner_errors_px) == 5
    assert max(found.corner_errors_px) < 1e-3
    row = {}
    for table in (matching_table([result], "a", ""), homography_table([result], "b", "")):
        row |= dict(zip([c.title for c in table.columns], table.rows[0], strict=True))
    assert row["precision at 1 px"] == row["accuracy at 1 px"] == 1
    assert row["AUC at 3 px"] == pytest.approx(1, abs=1e-3)
    assert row["± of AUC 3"] == pytest.approx(0, abs=1e-3)


def test_learned_descriptors_are_matched_without_a_ratio_test(
    pairs: list[PlanarPair], tmp_path: Path
) -> None:
    method = with_common_descriptor(CLASSICAL["fast-low"])
    tested, untested = (
        measure(
            BenchmarkContext(tmp_path), dataclasses.replace(method, learned=learned), pairs, (512,)
        )
        for learned in (False, True)
    )
    assert untested.pairs[1].matches.matches > tested.pairs[1].matches.matches
    assert untested.pairs[1].all_matches == tested.pairs[1].all_matches


def test_kinds_of_pairs_have_their_own_means(pairs: list[PlanarPair], tmp_path: Path) -> None:
    kinds = "still", "darker"
    chosen = [dataclasses.replace(p, kind=k) for p, k in zip(pairs, kinds, strict=True)]
    result = measure(BenchmarkContext(tmp_path), FAST, chosen, (64, 2048))
    still, darker = result.pairs
    kind = kind_table([result], "key", "pairs")
    assert [column.title for column in kind.columns[2:]] == [
        f"{kind}: {what}" for kind in kinds for what in ("@1 px", "@3 px", "correct")
    ]
    # The budget of the table is not filled by these small images.
    assert kind.rows[0][2:] == (
        *(None, None, still.matches.correct[0]),
        *(None, None, darker.matches.correct[0]),
    )
    (only,) = result.of_kind("darker").pairs
    assert only is darker
    value, chance = result.of_kind("darker").repeatability(64, 0) or (0, 0)
    assert value == darker.repeatability[64][0].value > chance
    assert result.repeatability(2048, 0) is None


def test_the_time_of_a_pair_is_that_of_all_stages(pairs: list[PlanarPair], tmp_path: Path) -> None:
    result = measure(BenchmarkContext(tmp_path), FAST, pairs, (64,))
    one = result.pairs[0]
    stages = [one.profiles[stage].seconds for stage in ("detect", "describe", "match")]
    assert one.seconds == pytest.approx(2 * stages[0] + stages[1] + stages[2])
    assert result.median_seconds() == pytest.approx(np.mean([p.seconds for p in result.pairs]))
    assert dataclasses.replace(result, feature=random_feature(FAST)).median_seconds() is None
    assert FeatureResult(FAST, []).median_seconds() is None


def test_a_pair_that_fails_is_skipped_and_the_others_count(
    pairs: list[PlanarPair], tmp_path: Path
) -> None:
    bad = load_image(pairs[1].second)

    def detect(rgb: np.ndarray) -> Keypoints:
        if np.array_equal(rgb, bad):
            raise BaselineError("not this one")
        return CLASSICAL["fast"].detect(rgb)

    feature = dataclasses.replace(FAST, detect=detect, detection="fails")
    context = BenchmarkContext(tmp_path)
    part = standard_part(context, [feature], pairs, "key", "pairs")
    assert len(part.tasks) == 2
    found = {key: context.try_run(task.name, task.run) for key, task in part.tasks.items()}
    (kept,) = [result for result in found.values() if result is not None]
    assert isinstance(kept, PairResult)
    tables = part.summarize({key: value for key, value in found.items() if value is not None})
    assert all(table.rows[0][1] == 1 for table in tables if isinstance(table, Table))
    (note,) = context.skipped
    assert "smoky 1-2" in note
    assert "not this one" in note


def test_a_pair_without_keypoints_counts_as_wrong_and_is_no_error(
    pairs: list[PlanarPair], tmp_path: Path
) -> None:
    def nothing(rgb: np.ndarray) -> Keypoints:
        return Keypoints.empty((rgb.shape[1], rgb.shape[0]))

    method = dataclasses.replace(
        with_common_descriptor(CLASSICAL["fast"]), detect=nothing, detection="nothing"
    )
    result = measure(BenchmarkContext(tmp_path), method, pairs, (64, None))
    assert [pair.matches.matches for pair in result.pairs] == [0, 0]
    assert {error for pair in result.pairs for error in pair.corner_errors_px} == {math.inf}
    assert matching_table([result], "key", "what").rows[0][2:] == (0,) * 8
    assert homography_table([result], "key", "what").rows[0][2:] == (0,) * 12
    assert math.isnan(result.pairs[0].repeatability[64][0].localization_px)


@pytest.fixture(scope="module")
def report(low_visibility_folder: Path, edge_detector: DeepDetect, tmp_path_factory) -> Report:
    def fail(rgb: np.ndarray) -> Keypoints:
        raise BaselineError("never")

    never = LocalFeature("never", "Never works", fail, CLASSICAL["fast"].describe)
    options = BenchmarkOptions(edge_detector, ("standard",), ("fast",), (never,))
    cache = tmp_path_factory.mktemp("cache")
    return run_benchmarks(["low-visibility"], low_visibility_folder, options, cache=cache)


def test_all_tables_of_the_section_have_all_methods(report: Report) -> None:
    titles = [
        *("FAST", "Never works", "DeepDetect, pixels by logits, suppression 3x3, sub-pixel"),
        "DeepDetect, native resolution, all pixels over 0.5",
    ]
    tables = {table.key: table for table in report.tables()}
    assert list(tables) == [
        *(f"low_visibility_repeatability_{r}px" for r in (1, 2, 3)),
        *("low_visibility_matching", "low_visibility_homography", "low_visibility_accuracy"),
        "low_visibility_cost",
    ]
    for table in tables.values():
        rows = [row[0] for row in table.rows]
        assert len(rows) == 8
        assert [title for title in titles if title in rows] == titles
    heads = [c.title for c in tables["low_visibility_repeatability_1px"].columns]
    assert len(heads) == len(set(heads)) == 2 + 3 * len(BUDGETS) + 2
    assert any("Never works" in note for note in report.skipped)


def test_the_figures_are_of_repeatability_accuracy_and_time(report: Report) -> None:
    assert [figure.key for figure in report.figures()] == [
        "low_visibility_accuracy",
        *(f"low_visibility_repeatability_{radius}px" for radius in (1, 3)),
        "low_visibility_time",
    ]


def test_rows_with_the_same_keypoints_are_one_line(
    pairs: list[PlanarPair], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = []
    monkeypatch.setattr(
        standard_figures, "line_chart", lambda lines, *_, **__: drawn.append(lines) or b""
    )
    again = dataclasses.replace(FAST, name="again", title="Described otherwise")
    context = BenchmarkContext(tmp_path)
    results = [measure(context, feature, pairs, (32, 64, None)) for feature in (FAST, again)]
    for k in (0, 2):
        standard_figures.repeatability_figure(results, k, "key", "pairs", (32, 64, None))
        (numbers, values) = drawn[-1]["FAST"]
        assert list(drawn[-1]) == ["FAST"]
        assert numbers == [32, 64]
        expected = [
            np.mean([p.repeatability[n][k].value for p in results[0].pairs]) for n in numbers
        ]
        assert values == pytest.approx(expected)


def test_a_method_that_never_works_has_dashes(report: Report) -> None:
    for table in report.tables():
        for row in table.shown():
            if row[0] == "Never works":
                assert set(row[1:]) <= {"–", "0"}


def test_baselines_are_worth_what_chance_is(report: Report) -> None:
    table = report.tables()[0]
    heads = [column.title for column in table.columns]
    rows = {row[0]: dict(zip(heads, row, strict=True)) for row in table.rows}
    every = rows["baseline: all pixels (a grid, where there is a budget)"]
    assert every["all"] == 1
    assert every["all: chance"] == 1
    assert every["all: chance-corrected"] is None, "nothing can be distinguished from chance"
    assert every["keypoints of all"] == 80 * 64
    # Of smoky's two images the random points differ; dusty's are one image twice.
    own = rows["DeepDetect, pixels by logits, suppression 3x3, sub-pixel"]
    assert own["512: chance-corrected"] is None or own["512: chance-corrected"] > 0.3
    assert own["all"] > own["all: chance"]
