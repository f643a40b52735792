"""The standard metrics on pairs with homographies, at equal budgets and beside chance."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ...datasets.types import PlanarPair
from ...features.keypoints import Keypoints
from ...geometry import GeometryOptions, estimate_geometry
from ...io.image import load_image
from ..baselines.method import LocalFeature
from ..cache import matrix_digest
from ..charts import line_chart
from ..context import BenchmarkContext, MatchSettings, PairMatches
from ..metrics.coverage import coverage
from ..metrics.homography import (
    CORNER_THRESHOLDS_PX,
    Sizes,
    accuracy_at,
    area_under_curve,
    corner_error,
)
from ..metrics.matching import MatchAccuracy, match_accuracy, mean_matching_accuracy
from ..metrics.repeatability import Repeatability, mutual_nn_repeatability
from ..profiling import Profile
from ..report import Cell, Column, Figure, Table
from ..tasks import Part, Task

BUDGETS: tuple[int | None, ...] = (512, 1024, 2048, 4096, 8192, None)
RADII_PX = (1.0, 2.0, 3.0)
SEEDS = 5
MATCHING_BUDGET = 2048
RATIO = 0.85
INLIER_THRESHOLD_PX = 3.0

MIN_FILLED = 0.9
"""A budget is shown where a method fills at least this fraction of it, on average."""

MAX_CHANCE = 0.95
"""Chance beyond which nothing can be distinguished from it."""

PROFILED_STAGES = ("detect", "describe", "match")


@dataclass(frozen=True)
class PairResult:
    """What one feature gives on one pair.

    Attributes:
        repeatability: by budget, the result at each of `RADII_PX`.
        coverage: by budget, of the first image.
        counts: by budget, and for the matching, the keypoints used in the image that has fewer.
        matches: with the ratio test.
        all_matches: mutual nearest neighbours without a ratio test.
        corner_errors_px: of the homography by each seed.
        profiles: by stage ("detect", "describe", "match"), when it was done.
    """

    repeatability: Mapping[int | None, list[Repeatability]]
    coverage: Mapping[int | None, float]
    counts: Mapping[int | None, int]
    matches: MatchAccuracy
    all_matches: MatchAccuracy
    corner_errors_px: list[float]
    profiles: Mapping[str, Profile]


@dataclass(frozen=True)
class FeatureResult:
    """What one feature gives on the pairs that could be measured."""

    feature: LocalFeature
    pairs: list[PairResult]


def standard_part(
    context: BenchmarkContext,
    features: Sequence[LocalFeature],
    pairs: Sequence[PlanarPair],
    key: str,
    what: str,
    budgets: Sequence[int | None] = BUDGETS,
) -> Part:
    """Measure all features on all pairs.

    Args:
        context: data and cache.
        features: what is compared.
        pairs: what it is measured on.
        key: beginning of the tables' keys.
        what: the data, for the tables' titles.
        budgets: numbers of keypoints; None: all.
    """
    tasks = {
        (feature.name, pair.name): Task(
            f"{feature.title} on {pair.name}",
            partial(measure_pair, context, feature, pair, budgets),
        )
        for feature in features
        for pair in pairs
    }

    def summarize(found: Mapping[Any, PairResult]) -> Sequence[Table | Figure]:
        names = [pair.name for pair in pairs]
        results = [
            FeatureResult(f, [found[f.name, n] for n in names if (f.name, n) in found])
            for f in features
        ]
        return [
            *(repeatability_table(results, k, key, what, budgets) for k in range(len(RADII_PX))),
            matching_table(results, key, what),
            homography_table(results, key, what),
            accuracy_table(results, key, what),
            cost_table(results, key, budgets),
            accuracy_figure(results, key, what),
        ]

    return Part(tasks, summarize)


def measure_pair(
    context: BenchmarkContext,
    feature: LocalFeature,
    pair: PlanarPair,
    budgets: Sequence[int | None] = BUDGETS,
) -> PairResult:
    """Measure a feature on a pair."""
    images = (pair.first, pair.second)
    sizes = (_image_size(pair.first), _image_size(pair.second))
    found = [context.keypoints(feature, image) for image in images]
    # Each position once: another orientation of SIFT's is not another place.
    places = [one.features.distinct() for one in found]
    fewest = min(len(features) for features in places)
    ratio = 1.0 if feature.learned else RATIO
    settings = MatchSettings("exact", ratio, mutual=True, budget=MATCHING_BUDGET)
    matches = context.matches(feature, images, settings)
    unfiltered = MatchSettings("exact", 1.0, mutual=True, budget=MATCHING_BUDGET)
    everything = context.matches(feature, images, unfiltered)
    profiles = found[0].profile, matches.describe, matches.match
    return PairResult(
        repeatability={
            b: _repeatability(context, feature, pair, sizes, places, b) for b in budgets
        },
        coverage={
            b: _coverage(context, feature, pair.first, sizes[0], places[0], b) for b in budgets
        },
        counts={b: fewest if b is None else min(fewest, b) for b in (*budgets, MATCHING_BUDGET)},
        matches=_evaluate(matches, pair, sizes),
        all_matches=_evaluate(everything, pair, sizes),
        corner_errors_px=_corner_errors(context, feature, pair, matches, settings, sizes[0]),
        profiles=dict(zip(PROFILED_STAGES, profiles, strict=True)),
    )


def _image_size(path: Path) -> tuple[int, int]:
    height, width = load_image(path).shape[:2]
    return width, height


def _evaluate(matches: PairMatches, pair: PlanarPair, sizes: Sizes) -> MatchAccuracy:
    return match_accuracy(
        matches.points0,
        matches.points1,
        matches.keypoints0,
        matches.keypoints1,
        pair.homography,
        sizes,
    )


def _corner_errors(
    context: BenchmarkContext,
    feature: LocalFeature,
    pair: PlanarPair,
    matches: PairMatches,
    settings: MatchSettings,
    size: tuple[int, int],
) -> list[float]:
    def error(seed: int) -> float:
        options = GeometryOptions(
            model="homography", inlier_threshold=INLIER_THRESHOLD_PX, seed=seed
        )
        estimated = estimate_geometry(matches.points0, matches.points1, options).matrix
        return corner_error(estimated, pair.homography, size)

    depends = {
        "homography": matrix_digest(pair.homography),
        "settings": vars(settings),
        "estimate": [INLIER_THRESHOLD_PX, SEEDS],
    }
    found = context.metric(
        "corner_errors",
        feature,
        (pair.first, pair.second),
        depends,
        lambda: {"errors": np.array([error(seed) for seed in range(SEEDS)])},
    )
    errors: list[float] = found["errors"].tolist()
    return errors


def _repeatability(
    context: BenchmarkContext,
    feature: LocalFeature,
    pair: PlanarPair,
    sizes: Sizes,
    places: Sequence[Keypoints],
    budget: int | None,
) -> list[Repeatability]:
    def make() -> dict[str, np.ndarray]:
        first, second = (_best(features, budget) for features in places)
        found = mutual_nn_repeatability(first, second, pair.homography, sizes, RADII_PX)
        rows = [(e.radius_px, e.repeated, e.fewest, e.localization_px, e.chance) for e in found]
        return {"rows": np.array(rows, np.float64)}

    depends = {
        "homography": matrix_digest(pair.homography),
        "budget": budget,
        "radii": list(RADII_PX),
    }
    images = (pair.first, pair.second)
    rows = context.metric("repeatability_mutual_nn", feature, images, depends, make)["rows"]
    return [Repeatability(r, int(n), int(f), away, chance) for r, n, f, away, chance in rows]


def _coverage(
    context: BenchmarkContext,
    feature: LocalFeature,
    image: Path,
    size: tuple[int, int],
    places: Keypoints,
    budget: int | None,
) -> float:
    def make() -> dict[str, np.ndarray]:
        return {"value": np.array(coverage(_best(places, budget), size))}

    found = context.metric("coverage", feature, (image,), {"budget": budget}, make)
    return float(found["value"])


def _best(features: Keypoints, budget: int | None) -> np.ndarray:
    return (features if budget is None else features.best(budget)).xy


def repeatability_table(
    results: Sequence[FeatureResult],
    k: int,
    key: str,
    what: str,
    budgets: Sequence[int | None] = BUDGETS,
) -> Table:
    """Tabulate the mutual-NN repeatability at the radius `RADII_PX[k]`."""
    radius = RADII_PX[k]
    columns = [Column("method"), Column("pairs", ",d")]
    for budget in budgets:
        name = _name(budget)
        columns += [
            Column(name, ".3f"),
            Column(f"{name}: chance", ".3f"),
            Column(f"{name}: chance-corrected", ".3f"),
        ]
    columns += [
        Column("keypoints of all", ",.0f"),
        Column(f"localization at {MATCHING_BUDGET:,}, px", ".2f"),
    ]
    rows: list[tuple[Cell, ...]] = []
    for result in results:
        cells: list[Cell] = [result.feature.title, len(result.pairs)]
        for budget in budgets:
            cells += _value_and_chance(result, budget, k)
        cells.append(_mean(pair.counts[None] for pair in result.pairs))
        middle = [pair.repeatability[MATCHING_BUDGET][k] for pair in result.pairs]
        cells.append(_mean(entry.localization_px for entry in middle if entry.repeated))
        rows.append(tuple(cells))
    note = (
        "Keypoints that are mutual nearest neighbours, at most the radius apart, over the fewer of "
        "the keypoints that both images show, each position once; by number of keypoints in each "
        "image, mean over the pairs. Chance: the same number of random points. Chance-corrected: 0 "
        f"is chance, 1 is all; a dash where chance is over {MAX_CHANCE:.0%}. A budget that a "
        f"method does not fill to {MIN_FILLED:.0%} is a dash. Localization: mean distance of the "
        "pairs of keypoints, where there are any."
    )
    title = f"Mutual-NN repeatability within {radius:g} px, {what}"
    return Table(f"{key}_repeatability_{radius:g}px", title, tuple(columns), tuple(rows), note)


def _value_and_chance(result: FeatureResult, budget: int | None, k: int) -> list[Cell]:
    filled = _mean(pair.counts[budget] for pair in result.pairs)
    if filled is None or (budget is not None and filled < MIN_FILLED * budget):
        return [None, None, None]
    entries = [pair.repeatability[budget][k] for pair in result.pairs]
    value = float(np.mean([entry.value for entry in entries]))
    chance = float(np.mean([entry.chance for entry in entries]))
    return [value, chance, None if chance > MAX_CHANCE else (value - chance) / (1 - chance)]


def matching_table(results: Sequence[FeatureResult], key: str, what: str) -> Table:
    """Tabulate the matches."""
    columns = (
        Column("method"),
        Column("pairs", ",d"),
        Column("keypoints", ",.0f"),
        Column("matches", ",.0f"),
        *(Column(f"correct at {t} px", ",.0f") for t in (1, 3)),
        *(Column(f"precision at {t} px", ".3f") for t in (1, 3)),
        *(Column(f"matching score at {t} px", ".3f") for t in (1, 3)),
    )
    rows: list[tuple[Cell, ...]] = []
    for result in results:
        matches = [pair.matches for pair in result.pairs]
        rows.append(
            (
                result.feature.title,
                len(matches),
                _mean(pair.counts[MATCHING_BUDGET] for pair in result.pairs),
                _mean(one.matches for one in matches),
                *(_mean(one.correct[t - 1] for one in matches) for t in (1, 3)),
                *(_mean(one.precision(t) for one in matches) for t in (1, 3)),
                *(_mean(one.matching_score(t) for one in matches) for t in (1, 3)),
            )
        )
    return Table(f"{key}_matching", f"Matches, {what}", columns, tuple(rows), MATCHING_NOTE)


MATCHING_NOTE = (
    f"The best {MATCHING_BUDGET:,} keypoints of each image; the same upright RootSIFT of size "
    "4 for all, except for methods with descriptors of their own; mutual nearest neighbours, "
    f"ratio {RATIO} (none for learned descriptors). Means over the pairs; no matches count as "
    "a precision of 0."
)


def homography_table(results: Sequence[FeatureResult], key: str, what: str) -> Table:
    """Tabulate the homographies that the matches give, with their spread over the seeds."""
    metrics: tuple[tuple[str, Callable[[Sequence[float], float], float]], ...] = (
        ("accuracy", accuracy_at),
        ("AUC", area_under_curve),
    )
    columns = [Column("method"), Column("pairs", ",d")]
    for name, _ in metrics:
        for threshold in CORNER_THRESHOLDS_PX:
            columns += [
                Column(f"{name} at {threshold:g} px", ".3f"),
                Column(f"± of {name} {threshold:g}", ".3f"),
            ]
    rows: list[tuple[Cell, ...]] = []
    for result in results:
        seeds = list(zip(*(pair.corner_errors_px for pair in result.pairs), strict=True))
        cells: list[Cell] = [result.feature.title, len(result.pairs)]
        for _, metric in metrics:
            for threshold in CORNER_THRESHOLDS_PX:
                values = [metric(errors, threshold) for errors in seeds]
                known = bool(values)
                cells.append(float(np.mean(values)) if known else None)
                cells.append(float(np.std(values, ddof=1)) if known else None)
        rows.append(tuple(cells))
    note = (
        f"{MATCHING_NOTE} MAGSAC at {INLIER_THRESHOLD_PX:g} px. Error: mean distance of the first "
        "image's corners from where the true homography takes them, at the images' own size; a "
        "pair without a homography counts as wrong. Accuracy: fraction of the pairs within a "
        "threshold; AUC: exact area under it, up to the threshold. Mean and standard deviation (±) "
        f"over {SEEDS} seeds of MAGSAC."
    )
    title = f"Homographies, {what}"
    return Table(f"{key}_homography", title, tuple(columns), tuple(rows), note)


def accuracy_table(results: Sequence[FeatureResult], key: str, what: str) -> Table:
    """Tabulate the mean matching accuracy at 1 to 10 px."""
    columns = (
        Column("method"),
        Column("pairs", ",d"),
        Column("matches", ",.0f"),
        *(Column(f"{t} px", ".3f") for t in range(1, 11)),
    )
    rows = tuple(
        (
            result.feature.title,
            len(result.pairs),
            _mean(pair.all_matches.matches for pair in result.pairs),
            *(_accuracy(result) if result.pairs else (None,) * 10),
        )
        for result in results
    )
    note = (
        f"Mutual nearest neighbours of the best {MATCHING_BUDGET:,} keypoints, no ratio test for "
        "any method: fraction of the matches within each distance, mean over the pairs."
    )
    return Table(f"{key}_accuracy", f"Mean matching accuracy, {what}", columns, rows, note)


def accuracy_figure(results: Sequence[FeatureResult], key: str, what: str) -> Figure:
    """Draw the mean matching accuracy."""
    lines = {
        result.feature.title: (range(1, 11), _accuracy(result))
        for result in results
        if result.pairs
    }
    png = line_chart(lines, "error up to, px", "mean matching accuracy")
    return Figure(f"{key}_accuracy", f"Mean matching accuracy, {what}", png)


def _accuracy(result: FeatureResult) -> tuple[float, ...]:
    return mean_matching_accuracy([pair.all_matches for pair in result.pairs])


def cost_table(
    results: Sequence[FeatureResult], key: str, budgets: Sequence[int | None] = BUDGETS
) -> Table:
    """Tabulate coverage, seconds and memory."""
    columns = (
        Column("method"),
        Column("pairs", ",d"),
        *(Column(f"coverage, {_name(budget)}", ".3f") for budget in budgets),
        *(Column(f"{stage}, s", ".3f") for stage in PROFILED_STAGES),
        *(Column(f"{stage}, MB", ",.0f") for stage in PROFILED_STAGES),
    )
    rows: list[tuple[Cell, ...]] = []
    for result in results:
        times: list[Cell] = []
        memory: list[Cell] = []
        for stage in PROFILED_STAGES:
            profiles = [pair.profiles[stage] for pair in result.pairs]
            known = profiles and not (result.feature.chance and stage == "detect")
            times.append(float(np.median([p.seconds for p in profiles])) if known else None)
            memory.append(max(p.memory for p in profiles) / 1e6 if profiles else None)
        covered = [_mean(pair.coverage[b] for pair in result.pairs) for b in budgets]
        rows.append((result.feature.title, len(result.pairs), *covered, *times, *memory))
    note = (
        "Coverage: fraction of the cells of 32x32 px that hold a keypoint of the first image. "
        "Seconds: the median when the results were made, on whatever else the machine did then; "
        "detecting in one image, describing both, matching the pair at "
        f"{MATCHING_BUDGET:,} keypoints (`deepdetect benchmark speed` compares on equal terms). "
        "Memory: the largest growth of the process."
    )
    return Table(f"{key}_cost", "Coverage, time and memory", columns, tuple(rows), note)


def _name(budget: int | None) -> str:
    return "all" if budget is None else f"{budget:,}"


def _mean(values: Iterable[float]) -> float | None:
    known = [value for value in values if value == value]
    return float(np.mean(known)) if known else None
