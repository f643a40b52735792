"""The tables of the standard protocol."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from ..metrics.homography import CORNER_THRESHOLDS_PX, accuracy_at, area_under_curve
from ..metrics.matching import MatchAccuracy, mean_matching_accuracy
from ..report import Cell, Column, Table
from .standard_results import (
    BUDGETS,
    INLIER_THRESHOLD_PX,
    MATCHING_BUDGET,
    MAX_CHANCE,
    MIN_FILLED,
    PROFILED_STAGES,
    RADII_PX,
    RATIO,
    SEEDS,
    Columns,
    FeatureResult,
    PairResult,
    budget_name,
    tabulate,
)


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
            cell = partial(_with_chance, budget=budget, k=k, place=place)
            columns.append((Column(f"{budget_name(budget)}{title}", ".3f"), cell))

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
    return tabulate(results, f"{key}_repeatability_{RADII_PX[k]:g}px", title, columns, note)


def _with_chance(result: FeatureResult, budget: int | None, k: int, place: int) -> Cell:
    """Return the repeatability, its chance, or the chance-corrected value."""
    found = result.repeatability(budget, k)
    if found is None:
        return None
    value, chance = found
    corrected = None if chance > MAX_CHANCE else (value - chance) / (1 - chance)
    return (value, chance, corrected)[place]


def kind_table(results: Sequence[FeatureResult], key: str, what: str) -> Table:
    """Tabulate repeatability and correct matches by what changes between the images of a pair."""

    def repeated(one: FeatureResult, kind: str, k: int) -> Cell:
        found = one.of_kind(kind).repeatability(MATCHING_BUDGET, k)
        return None if found is None else found[0]

    def correct(one: FeatureResult, kind: str) -> Cell:
        return one.of_kind(kind).correct()

    kinds = kinds_of(results)
    columns: Columns = [
        (Column(f"{kind}: {title}", style), cell)
        for kind in kinds
        for title, style, cell in (
            *(
                (f"@{RADII_PX[k]:g} px", ".3f", partial(repeated, kind=kind, k=k))
                for k in (0, len(RADII_PX) - 1)
            ),
            ("correct", ",.0f", partial(correct, kind=kind)),
        )
    ]
    note = (
        f"By what changes between the two images, at {MATCHING_BUDGET:,} keypoints: mutual-NN "
        "repeatability, and correct matches at 1 px. Means over the pairs of a kind."
    )
    return tabulate(results, f"{key}_kinds", f"By kind of pair, {what}", columns, note)


def kinds_of(results: Sequence[FeatureResult]) -> list[str]:
    """Return the kinds of pairs, in the order in which they come; those without are left out."""
    kinds = (pair.kind for one in results for pair in one.pairs if pair.kind)
    return list(dict.fromkeys(kinds))


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
    return tabulate(results, f"{key}_matching", f"Matches, {what}", columns, MATCHING_NOTE)


MATCHING_NOTE = (
    f"The best {MATCHING_BUDGET:,} keypoints of each image; the same upright RootSIFT of size "
    "4 for all, except in the rows that name others; mutual nearest neighbours, "
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
    return tabulate(results, f"{key}_homography", f"Homographies, {what}", columns, note)


def accuracy_table(results: Sequence[FeatureResult], key: str, what: str) -> Table:
    """Tabulate the mean matching accuracy at 1 to 10 px."""

    def accuracy(one: FeatureResult, t: int) -> Cell:
        return mean_accuracy(one)[t - 1] if one.pairs else None

    columns: Columns = [
        (Column("matches", ",.0f"), lambda one: one.mean(lambda p: p.all_matches.matches)),
        *((Column(f"{t} px", ".3f"), partial(accuracy, t=t)) for t in range(1, 11)),
    ]
    note = (
        f"Mutual nearest neighbours of the best {MATCHING_BUDGET:,} keypoints, no ratio test for "
        "any method: fraction of the matches within each distance, mean over the pairs."
    )
    title = f"Mean matching accuracy, {what}"
    return tabulate(results, f"{key}_accuracy", title, columns, note)


def mean_accuracy(result: FeatureResult) -> tuple[float, ...]:
    """Return the mean matching accuracy at 1 to 10 px."""
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
        *(
            (Column(f"coverage, {budget_name(b)}", ".3f"), partial(covered, budget=b))
            for b in budgets
        ),
        *((Column(f"{s}, s", ".3f"), partial(seconds, stage=s)) for s in PROFILED_STAGES),
        (Column("pair, s", ".3f"), FeatureResult.median_seconds),
        (Column("correct at 1 px", ",.0f"), FeatureResult.correct),
        *((Column(f"{s}, MB", ",.0f"), partial(megabytes, stage=s)) for s in PROFILED_STAGES),
    ]
    note = (
        "Coverage: fraction of the cells of 32x32 px that hold a keypoint of the first image. "
        "Seconds: the median when the results were made, on whatever else the machine did then; "
        "detecting in one image, describing both, matching the pair at "
        f"{MATCHING_BUDGET:,} keypoints (`deepdetect benchmark speed` compares on equal terms). "
        "Pair: detecting in both images, describing and matching them. "
        "Memory: the largest growth of the process."
    )
    return tabulate(results, f"{key}_cost", "Coverage, time and memory", columns, note)
