"""Matches by descriptors alone and guided ones, each with its precision, beside chance.

Guided matching multiplies the matches of any points, those that know nothing about the image too:
only beside them does a count say something.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from ...datasets.types import PlanarPair
from ...features.keypoints import nearest_keypoints
from ...geometry import transform_points
from ...geometry.residuals import transfer_errors
from ...io.image import load_image, luma
from ...matching.guided import guided_matches
from ..baselines.method import LocalFeature
from ..cache import Arrays
from ..context import BenchmarkContext, feature_key, pack_profile, unpack_profile
from ..metrics.homography import corner_error
from ..options import BenchmarkOptions
from ..profiling import Profile, profiled
from ..report import Cell, Column, Figure, Table
from ..tasks import Part, SectionPlan, Task
from .paper import CORRECT_PX, PAPER_MATCHING

SEEDS = 3

COLUMNS = (
    Column("pair"),
    Column("method"),
    Column("matchable", ",d"),
    Column("descriptors alone: correct", ",d"),
    Column("descriptors alone: precision", ".2%"),
    Column("guided by"),
    Column("guided: correct", ",d"),
    Column("± of correct", ",.0f"),
    Column("guided: precision", ".2%"),
    Column("guided: of the matchable", ".1%"),
    Column("lowest", ".1%"),
    Column("guided: unique", ",d"),
    Column("guided: corner error, px", ".2f"),
    Column("guided: seconds", ".2f"),
)

NOTE = (
    f"Correct: strictly under {CORRECT_PX:g} px by the true homography; each point of the first "
    "image counts once. Matchable: points of the first image with any point of the second this "
    "near to their true place. Unique: correct matches, each point of the second image once. "
    f"Guided: the seed of the median count, the lower of two, of {SEEDS} seeds; ± is the counts' "
    "standard deviation, lowest the smallest of them as a fraction of the matchable. A seed by "
    "which no geometry is trusted has no matches, as from match_images; the row says how many "
    "seeds were guided where not all were. Corner error: median "
    "over the seeds that a homography guided. Seconds: median of the guided matching alone, "
    "without heat map, keypoints and matches by descriptors; they may be those of an earlier run, "
    "from the cache. The count of the baselines is what the same geometry makes of points that "
    "know nothing about the image."
)


@dataclass(frozen=True, eq=False)
class GuidedPair:
    """The matches of a pair by one seed, as `match_images` gives them.

    Attributes:
        kind: what guided, as of `TwoViewGeometry`; with "none" there are no matches.
        matrix: the geometry, or None.
        points0, points1: (M, 2) matched positions.
        profile: of the guided matching alone, also where it found nothing: heat map and keypoints
            are not included.
    """

    kind: str
    matrix: np.ndarray | None
    points0: np.ndarray
    points1: np.ndarray
    profile: Profile


def guided_section(
    context: BenchmarkContext,
    options: BenchmarkOptions,
    truths: Mapping[str, Sequence[PlanarPair]],
    key: str,
    title: str,
) -> SectionPlan:
    """Match pairs by descriptors alone and guided.

    Args:
        context: data and cache.
        options: what is compared.
        truths: by name, the same pairs with the homographies that evaluate them.
        key: beginning of the tables' keys.
        title: of the section.
    """
    features = (options.deepdetect_480(), *options.chance_baselines())
    tasks = {}
    for pairs in zip(*truths.values(), strict=True):
        by_truth = dict(zip(truths, pairs, strict=True))
        for feature in features:
            name = f"guided matches of {feature.title} on {pairs[0].name}"
            run = partial(_measure, context, feature, by_truth)
            tasks[pairs[0].name, feature.title] = Task(name, run)

    def summarize(found: Mapping[Any, dict[str, tuple[Cell, ...]]]) -> Sequence[Table | Figure]:
        return [
            Table(
                f"{key}_{truth}".replace(" ", "_"),
                f"Matches by descriptors alone and guided, {truth} homographies",
                COLUMNS,
                tuple((*names, *cells[truth]) for names, cells in found.items()),
                NOTE,
            )
            for truth in truths
        ]

    text = (
        "By descriptors alone: the paper's matching (SIFT of size 3, FLANN, ratio 0.99). Guided: "
        "the default of `match_images`: a geometry from a few of OpenCV's SIFT keypoints proposes, "
        "and a pair is kept when both places look the same. The true homography is used for "
        "evaluation only. DeepDetect sees images squashed to 480x480 as "
        f"{options.channels.upper()}."
    )
    return SectionPlan(f"{title}, descriptors alone and guided", (text,), [Part(tasks, summarize)])


def _measure(
    context: BenchmarkContext, feature: LocalFeature, by_truth: Mapping[str, PlanarPair]
) -> dict[str, tuple[Cell, ...]]:
    """Return the cells of a row by truth."""
    pair = next(iter(by_truth.values()))
    alone = context.matches(feature, (pair.first, pair.second), PAPER_MATCHING)
    guided = [match_guided(context, feature, pair, seed) for seed in range(SEEDS)]
    sizes = [load_image(image).shape[1::-1] for image in (pair.first, pair.second)]
    cells: dict[str, tuple[Cell, ...]] = {}
    for truth, one in by_truth.items():
        places = transform_points(alone.keypoints0, one.homography)
        gaps = nearest_keypoints(places, alone.keypoints1, sizes[1])[1]
        matchable = int(np.count_nonzero(gaps < CORRECT_PX))
        correct = _correct(alone.points0, alone.points1, one)
        cells[truth] = (
            matchable,
            int(correct.sum()),
            float(correct.mean()) if len(correct) else None,
            *_guided_cells(guided, one, matchable, sizes[0]),
        )
    return cells


def _guided_cells(
    guided: Sequence[GuidedPair], pair: PlanarPair, matchable: int, size: tuple[int, int]
) -> tuple[Cell, ...]:
    correct = [_correct(found.points0, found.points1, pair) for found in guided]
    counts = [int(one.sum()) for one in correct]
    middle = int(np.argsort(counts, kind="stable")[(len(counts) - 1) // 2])
    unique = np.unique(guided[middle].points1[correct[middle]], axis=0)
    planes = [found.matrix for found in guided if found.kind == "homography"]
    corners = [corner_error(matrix, pair.homography, size) for matrix in planes]
    return (
        _guided_by([found.kind for found in guided]),
        counts[middle],
        float(np.std(counts, ddof=1)) if len(counts) > 1 else None,
        float(correct[middle].mean()) if len(correct[middle]) else None,
        counts[middle] / matchable if matchable else None,
        min(counts) / matchable if matchable else None,
        len(unique),
        float(np.median(corners)) if corners else None,
        float(np.median([found.profile.seconds for found in guided])),
    )


def _guided_by(kinds: Sequence[str]) -> str:
    """Say what guided, and how many of the seeds where not all."""
    trusted = [kind for kind in kinds if kind != "none"]
    if not trusted:
        return "none"
    names = " or ".join(dict.fromkeys(trusted))
    if len(trusted) == len(kinds):
        return names
    return f"{names}, {len(trusted)} of {len(kinds)} seeds guided"


def _correct(points0: np.ndarray, points1: np.ndarray, pair: PlanarPair) -> np.ndarray:
    return transfer_errors(points0, points1, pair.homography) < CORRECT_PX


def match_guided(
    context: BenchmarkContext, feature: LocalFeature, pair: PlanarPair, seed: int
) -> GuidedPair:
    """Match a pair guided, or read that.

    Args:
        context: with the cache.
        feature: its keypoints lie on whole pixels.
        pair: its homography is not used.
        seed: of the guided matching.
    """
    images = (pair.first, pair.second)
    first, second = (context.keypoints(feature, image).features.xy for image in images)

    def make() -> Arrays:
        gray0, gray1 = (luma(load_image(image)) for image in images)
        with profiled() as profile:
            guide, found = guided_matches(gray0, gray1, first, second, seed=seed)
        return {
            "kind": np.array(guide.model),
            "matrix": np.empty((0, 3)) if guide.matrix is None else guide.matrix,
            "rows0": np.empty(0, np.int32) if found is None else found.indices0.astype(np.int32),
            "points1": np.empty((0, 2)) if found is None else found.points1,
            **pack_profile("guided", profile),
        }

    found = context.cache.get("guided", {**feature_key(feature, images), "seed": seed}, make)
    return GuidedPair(
        str(found["kind"]),
        found["matrix"] if len(found["matrix"]) else None,
        first[found["rows0"]],
        found["points1"],
        unpack_profile("guided", found),
    )
