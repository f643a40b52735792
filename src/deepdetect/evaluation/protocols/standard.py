"""The standard metrics on pairs with homographies, at equal budgets and beside chance."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

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
from ..tasks import Part, Shown, feature_part

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

    def mean(self, value: Callable[[PairResult], float]) -> float | None:
        """Average a value over the pairs where it is not NaN."""
        return _mean(value(pair) for pair in self.pairs)


Columns = Sequence[tuple[Column, Callable[[FeatureResult], Cell]]]


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

    def measure(feature: LocalFeature, pair: PlanarPair) -> PairResult:
        return measure_pair(context, feature, pair, budgets)

    def summarize(found: Mapping[tuple[str, str], PairResult]) -> Shown:
        results = [
            FeatureResult(f, [found[f.name, p.name] for p in pairs if (f.name, p.name) in found])
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

    return feature_part(features, {pair.name: pair for pair in pairs}, "", measure, summarize)


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


def _tabulate(
    results: Sequence[FeatureResult], key: str, title: str, columns: Columns, note: str
) -> Table:
    heads = (Column("method"), Column("pairs", ",d"), *(column for column, _ in columns))
    rows = (
        (one.feature.title, len(one.pairs), *(cell(one) for _, cell in columns)) for one in results
    )
    return Table(key, title, heads, tuple(rows), note)


def repeatability_table(
    results: Sequence[FeatureResult],
    k: int,
    key: str,
    what: str,
    budgets: Sequence[int | None] = BUDGETS,
) -> Table:
    """Tabulate the mutual-NN repeatability at the radius `RADII_PX[k]`."""
    columns: list[tuple[Column, Callable[[FeatureResult], Cell]]] = []
    for budget in budgets:
        for place, title in enumerate(("", ": chance", ": chance-corrected")):
            cell = partial(_value_and_chance, budget=budget, k=k, place=place)
            columns.append((Column(f"{_name(budget)}{title}", ".3f"), cell))

    def localization(pair: PairResult) -> float:
        entry = pair.repeatability[MATCHING_BUDGET][k]
        return entry.localization_px if entry.repeated else math.nan

    columns += [
        (Column("keypoints of all", ",.0f"), lambda one: one.mean(lambda p: p.counts[None])),
        (
            Column(f"localization at {MATCHING_BUDGET:,}, px", ".2f"),
            lambda one: one.mean(localization),
        ),
    ]
    note = (
        "Keypoints that are mutual nearest neighbours, at most the radius apart, over the fewer of "
        "the keypoints that both images show, each position once; by number of keypoints in each "
        "image, mean over the pairs. Chance: the same number of random points. Chance-corrected: 0 "
        f"is chance, 1 is all; a dash where chance is over {MAX_CHANCE:.0%}. A budget that a "
        f"method does not fill to {MIN_FILLED:.0%} is a dash. Localization: mean distance of the "
        "pairs of keypoints, where there are any."
    )
    title = f"Mutual-NN repeatability within {RADII_PX[k]:g} px, {what}"
    return _tabulate(results, f"{key}_repeatability_{RADII_PX[k]:g}px", title, columns, note)


def _value_and_chance(
    result: FeatureResult, budget: int | None, k: int, place: int
) -> float | None:
    """Return the repeatability, its chance, or the chance-corrected value; None if not filled."""
    filled = result.mean(lambda pair: pair.counts[budget])
    if filled is None or (budget is not None and filled < MIN_FILLED * budget):
        return None
    entries = [pair.repeatability[budget][k] for pair in result.pairs]
    value = float(np.mean([entry.value for entry in entries]))
    chance = float(np.mean([entry.chance for entry in entries]))
    corrected = None if chance > MAX_CHANCE else (value - chance) / (1 - chance)
    return (value, chance, corrected)[place]


def matching_table(results: Sequence[FeatureResult], key: str, what: str) -> Table:
    """Tabulate the matches."""

    def mean(value: Callable[[MatchAccuracy, int], float], t: int = 0) -> Callable[..., Cell]:
        return lambda one: one.mean(lambda pair: value(pair.matches, t))

    columns: Columns = [
        (Column("keypoints", ",.0f"), lambda one: one.mean(lambda p: p.counts[MATCHING_BUDGET])),
        (Column("matches", ",.0f"), mean(lambda found, _: found.matches)),
        *(
            (Column(f"{name} at {t} px", style), mean(value, t))
            for name, style, value in (
                ("correct", ",.0f", lambda found, t: found.correct[t - 1]),
                ("precision", ".3f", MatchAccuracy.precision),
                ("matching score", ".3f", MatchAccuracy.matching_score),
            )
            for t in (1, 3)
        ),
    ]
    return _tabulate(results, f"{key}_matching", f"Matches, {what}", columns, MATCHING_NOTE)


MATCHING_NOTE = (
    f"The best {MATCHING_BUDGET:,} keypoints of each image; the same upright RootSIFT of size "
    "4 for all, except for methods with descriptors of their own; mutual nearest neighbours, "
    f"ratio {RATIO} (none for learned descriptors). Means over the pairs; no matches count as "
    "a precision of 0."
)


def homography_table(results: Sequence[FeatureResult], key: str, what: str) -> Table:
    """Tabulate the homographies that the matches give, with their spread over the seeds."""

    def over_seeds(
        metric: Callable[[Sequence[float], float], float], threshold: float, spread: bool
    ) -> Callable[[FeatureResult], Cell]:
        def cell(one: FeatureResult) -> Cell:
            seeds = zip(*(pair.corner_errors_px for pair in one.pairs), strict=True)
            values = [metric(errors, threshold) for errors in seeds]
            if not values:
                return None
            return float(np.std(values, ddof=1) if spread else np.mean(values))

        return cell

    columns = [
        (Column(title.format(name, threshold), ".3f"), over_seeds(metric, threshold, spread))
        for name, metric in (("accuracy", accuracy_at), ("AUC", area_under_curve))
        for threshold in CORNER_THRESHOLDS_PX
        for title, spread in (("{} at {:g} px", False), ("± of {} {:g}", True))
    ]
    note = (
        f"{MATCHING_NOTE} MAGSAC at {INLIER_THRESHOLD_PX:g} px. Error: mean distance of the first "
        "image's corners from where the true homography takes them, at the images' own size; a "
        "pair without a homography counts as wrong. Accuracy: fraction of the pairs within a "
        "threshold; AUC: exact area under it, up to the threshold. Mean and standard deviation (±) "
        f"over {SEEDS} seeds of MAGSAC."
    )
    return _tabulate(results, f"{key}_homography", f"Homographies, {what}", columns, note)


def accuracy_table(results: Sequence[FeatureResult], key: str, what: str) -> Table:
    """Tabulate the mean matching accuracy at 1 to 10 px."""

    def accuracy(one: FeatureResult, t: int) -> Cell:
        return _accuracy(one)[t - 1] if one.pairs else None

    columns: Columns = [
        (Column("matches", ",.0f"), lambda one: one.mean(lambda p: p.all_matches.matches)),
        *((Column(f"{t} px", ".3f"), partial(accuracy, t=t)) for t in range(1, 11)),
    ]
    note = (
        f"Mutual nearest neighbours of the best {MATCHING_BUDGET:,} keypoints, no ratio test for "
        "any method: fraction of the matches within each distance, mean over the pairs."
    )
    title = f"Mean matching accuracy, {what}"
    return _tabulate(results, f"{key}_accuracy", title, columns, note)


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

    def covered(one: FeatureResult, budget: int | None) -> Cell:
        return one.mean(lambda pair: pair.coverage[budget])

    def seconds(one: FeatureResult, stage: str) -> Cell:
        known = one.pairs and not (one.feature.chance and stage == "detect")
        values = [pair.profiles[stage].seconds for pair in one.pairs]
        return float(np.median(values)) if known else None

    def megabytes(one: FeatureResult, stage: str) -> Cell:
        return max((pair.profiles[stage].memory / 1e6 for pair in one.pairs), default=None)

    columns: Columns = [
        *((Column(f"coverage, {_name(b)}", ".3f"), partial(covered, budget=b)) for b in budgets),
        *((Column(f"{s}, s", ".3f"), partial(seconds, stage=s)) for s in PROFILED_STAGES),
        *((Column(f"{s}, MB", ",.0f"), partial(megabytes, stage=s)) for s in PROFILED_STAGES),
    ]
    note = (
        "Coverage: fraction of the cells of 32x32 px that hold a keypoint of the first image. "
        "Seconds: the median when the results were made, on whatever else the machine did then; "
        "detecting in one image, describing both, matching the pair at "
        f"{MATCHING_BUDGET:,} keypoints (`deepdetect benchmark speed` compares on equal terms). "
        "Memory: the largest growth of the process."
    )
    return _tabulate(results, f"{key}_cost", "Coverage, time and memory", columns, note)


def _name(budget: int | None) -> str:
    return "all" if budget is None else f"{budget:,}"


def _mean(values: Iterable[float]) -> float | None:
    known = [value for value in values if value == value]
    return float(np.mean(known)) if known else None
