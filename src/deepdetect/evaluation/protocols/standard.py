"""The standard metrics on pairs with homographies, at equal budgets and beside chance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ...datasets.types import PlanarPair
from ...features.keypoints import Keypoints
from ...geometry import GeometryOptions, estimate_geometry
from ...io.image import load_image
from ..baselines.method import LocalFeature
from ..cache import matrix_digest
from ..context import BenchmarkContext, MatchSettings, PairMatches
from ..metrics.coverage import coverage
from ..metrics.homography import Sizes, corner_error
from ..metrics.matching import MatchAccuracy, match_accuracy
from ..metrics.repeatability import Repeatability, mutual_nn_repeatability
from ..tasks import Part, Shown, feature_part
from .standard_figures import accuracy_figure, repeatability_figure, time_figure
from .standard_results import (
    BUDGETS,
    INLIER_THRESHOLD_PX,
    MATCHING_BUDGET,
    PROFILED_STAGES,
    RADII_PX,
    RATIO,
    SEEDS,
    FeatureResult,
    PairResult,
)
from .standard_tables import (
    accuracy_table,
    cost_table,
    homography_table,
    kind_table,
    kinds_of,
    matching_table,
    repeatability_table,
)


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
        repeatability_figures = [
            repeatability_figure(results, k, key, what, budgets) for k in (0, len(RADII_PX) - 1)
        ]
        return [
            *(repeatability_table(results, k, key, what, budgets) for k in range(len(RADII_PX))),
            *([kind_table(results, key, what)] if kinds_of(results) else []),
            matching_table(results, key, what),
            homography_table(results, key, what),
            accuracy_table(results, key, what),
            cost_table(results, key, budgets),
            accuracy_figure(results, key, what),
            *repeatability_figures,
            time_figure(results, key, what),
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
        kind=pair.kind,
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
        estimated = estimate_geometry(
            matches.points0,
            matches.points1,
            "homography",
            seed=seed,
            options=GeometryOptions(inlier_threshold=INLIER_THRESHOLD_PX),
        ).matrix
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
