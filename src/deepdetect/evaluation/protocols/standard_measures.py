"""The field's measures on pairs with homographies, at equal budgets and beside chance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...datasets.types import PlanarPair
from ...features.keypoints import Keypoints
from ...geometry import GeometryOptions, estimate_geometry
from ..baselines import Method
from ..metrics.homography_accuracy import corner_error
from ..metrics.match_accuracy import MatchAccuracy, match_accuracy
from ..metrics.one_to_one import Repeatability, one_to_one_repeatability
from ..metrics.spread import coverage
from ..stages import FoundMatches, MatchSettings
from ..workspace import Workspace, image_size, matrix_key

BUDGETS: tuple[int | None, ...] = (512, 1024, 2048, 4096, 8192, None)
RADII = (1.0, 2.0, 3.0)
SEEDS = 5
MATCHING_BUDGET = 2048
RATIO = 0.85
INLIER_THRESHOLD = 3.0

Sizes = tuple[tuple[int, int], tuple[int, int]]


@dataclass(frozen=True)
class PairResult:
    """What one method gives on one pair.

    Attributes:
        repeatability: by budget, the result at each of `RADII`.
        coverage: by budget, of the first image.
        counts: by budget, and for the matching, the keypoints used in the image that has fewer.
        matches: judged, with the ratio test.
        all_matches: judged, mutual nearest neighbours without a ratio test.
        corner_errors: of the homography by each seed, in pixels.
        seconds, memory: by stage ("detect", "describe", "match"), when it was done.
    """

    repeatability: Mapping[int | None, list[Repeatability]]
    coverage: Mapping[int | None, float]
    counts: Mapping[int | None, int]
    matches: MatchAccuracy
    all_matches: MatchAccuracy
    corner_errors: list[float]
    seconds: Mapping[str, float]
    memory: Mapping[str, int]


@dataclass(frozen=True)
class StandardResult:
    """What one method gives on some pairs.

    Attributes:
        method: the method.
        pairs: one result for each pair that could be measured.
        asked: number of pairs that were to be measured.
    """

    method: Method
    pairs: list[PairResult]
    asked: int


def measure(
    workspace: Workspace,
    method: Method,
    pairs: Sequence[PlanarPair],
    budgets: Sequence[int | None] = BUDGETS,
) -> StandardResult:
    """Measure a method on pairs; a pair that fails is left out and noted.

    Each pair is one step of the workspace's progress.
    """
    results = []
    for pair in pairs:
        workspace.done(0, f"{method.name}, {pair.name}")
        what = f"{method.title} on {pair.name}"
        found = workspace.attempt(what, measure_pair, workspace, method, pair, budgets)
        workspace.done(1, f"{method.name}, {pair.name}")
        if found is not None:
            results.append(found)
    return StandardResult(method, results, len(pairs))


def measure_pair(
    workspace: Workspace, method: Method, pair: PlanarPair, budgets: Sequence[int | None] = BUDGETS
) -> PairResult:
    """Measure a method on a pair."""
    images = (pair.first, pair.second)
    sizes = (image_size(pair.first), image_size(pair.second))
    found = [workspace.keypoints(method, image) for image in images]
    # Positions, each once: an orientation of SIFT's is no further place.
    places = [one.features.distinct() for one in found]
    fewest = min(len(features) for features in places)
    ratio = 1.0 if method.learned else RATIO
    settings = MatchSettings("exact", ratio, mutual=True, budget=MATCHING_BUDGET)
    matches = workspace.matches(method, pair, settings)
    unfiltered = MatchSettings("exact", 1.0, mutual=True, budget=MATCHING_BUDGET)
    everything = workspace.matches(method, pair, unfiltered)
    stages = {"detect": found[0], "describe": matches.describing, "match": matches}
    return PairResult(
        repeatability={
            b: _repeatability(workspace, method, pair, sizes, places, b) for b in budgets
        },
        coverage={
            b: _coverage(workspace, method, pair.first, sizes[0], places[0], b) for b in budgets
        },
        counts={b: fewest if b is None else min(fewest, b) for b in (*budgets, MATCHING_BUDGET)},
        matches=_judge(matches, pair, sizes),
        all_matches=_judge(everything, pair, sizes),
        corner_errors=_corner_errors(workspace, method, pair, matches, settings, sizes),
        seconds={stage: timed.seconds for stage, timed in stages.items()},
        memory={stage: timed.memory for stage, timed in stages.items()},
    )


def _judge(matches: FoundMatches, pair: PlanarPair, sizes: Sizes) -> MatchAccuracy:
    return match_accuracy(
        matches.points0,
        matches.points1,
        matches.keypoints0,
        matches.keypoints1,
        pair.homography,
        sizes,
    )


def _corner_errors(
    workspace: Workspace,
    method: Method,
    pair: PlanarPair,
    matches: FoundMatches,
    settings: MatchSettings,
    sizes: Sizes,
) -> list[float]:
    def estimate(seed: int) -> np.ndarray | None:
        options = GeometryOptions(model="homography", inlier_threshold=INLIER_THRESHOLD, seed=seed)
        return estimate_geometry(matches.points0, matches.points1, options).matrix

    def make() -> dict[str, np.ndarray]:
        errors = [corner_error(estimate(s), pair.homography, sizes[0]) for s in range(SEEDS)]
        return {"errors": np.array(errors)}

    depends = {
        "homography": matrix_key(pair.homography),
        "settings": vars(settings),
        "estimate": [INLIER_THRESHOLD, SEEDS],
    }
    images = (pair.first, pair.second)
    return workspace.metric("corner errors", method, images, depends, make)["errors"].tolist()


def _repeatability(
    workspace: Workspace,
    method: Method,
    pair: PlanarPair,
    sizes: Sizes,
    places: Sequence[Keypoints],
    budget: int | None,
) -> list[Repeatability]:
    images = (pair.first, pair.second)

    def make() -> dict[str, np.ndarray]:
        points = [_best(features, budget) for features in places]
        found = one_to_one_repeatability(*points, pair.homography, sizes, RADII)
        rows = [(e.radius, e.repeated, e.fewest, e.localisation, e.chance) for e in found]
        return {"rows": np.array(rows, np.float64)}

    depends = {
        "homography": matrix_key(pair.homography),
        "budget": budget,
        "radii": list(RADII),
    }
    rows = workspace.metric("one-to-one repeatability", method, images, depends, make)["rows"]
    return [Repeatability(r, int(n), int(f), away, chance) for r, n, f, away, chance in rows]


def _coverage(
    workspace: Workspace,
    method: Method,
    image: Path,
    size: tuple[int, int],
    places: Keypoints,
    budget: int | None,
) -> float:
    def make() -> dict[str, np.ndarray]:
        return {"value": np.array(coverage(_best(places, budget), size))}

    found = workspace.metric("coverage", method, (image,), {"budget": budget}, make)
    return float(found["value"])


def _best(features: Keypoints, budget: int | None) -> np.ndarray:
    return (features if budget is None else features.best(budget)).xy
