"""The tables of the standard protocol."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..charts import line_chart
from ..metrics.homography_accuracy import THRESHOLDS as CORNERS
from ..metrics.homography_accuracy import area_under_curve, share_within
from ..metrics.match_accuracy import mean_matching_accuracy
from ..report import Cell, Column, Figure, Table
from .standard_measures import (
    INLIER_THRESHOLD,
    MATCHING_BUDGET,
    RADII,
    RATIO,
    SEEDS,
    PairResult,
    StandardResult,
)

FILLED = 0.9
"""A budget is shown where a method fills so much of it, on the mean."""

SATURATED = 0.95
"""Chance beyond which nothing can be told from it."""


def repeatability_tables(results: Sequence[StandardResult], key: str, what: str) -> list[Table]:
    """Tabulate the one-to-one repeatability at each radius."""
    budgets = _budgets(results)
    tables = []
    for k, radius in enumerate(RADII):
        columns = [Column("method"), Column("pairs", ",d")]
        for budget in budgets:
            name = _name(budget)
            columns += [
                Column(name, ".3f"),
                Column(f"{name}: chance", ".3f"),
                Column(f"{name}: above chance", ".3f"),
            ]
        columns += [
            Column("keypoints of all", ",.0f"),
            Column(f"localisation at {MATCHING_BUDGET:,}, px", ".2f"),
        ]
        rows: list[tuple[Cell, ...]] = []
        for result in results:
            cells: list[Cell] = [result.method.title, len(result.pairs)]
            for budget in budgets:
                cells += _value_and_chance(result, budget, k)
            cells.append(_mean(pair.counts[None] for pair in result.pairs))
            middle = [pair.repeatability[MATCHING_BUDGET][k] for pair in result.pairs]
            cells.append(_mean(entry.localisation for entry in middle if entry.repeated))
            rows.append(tuple(cells))
        note = (
            "Pairs of keypoints that are each other's nearest, at most the radius apart, over the "
            "fewer of the keypoints that both images show, each position once; by number of "
            "keypoints in each image, mean over the pairs. Chance: as many random points. Above "
            "chance: 0 is chance, 1 is all; a dash where chance is over "
            f"{SATURATED:.0%}. A budget that a method does not fill to {FILLED:.0%} is a dash. "
            "Localisation: mean distance of the pairs of keypoints, where there are any."
        )
        title = f"Repeatability one to one within {radius:g} px, {what}"
        name = f"{key}_repeatability_{radius:g}px"
        tables.append(Table(name, title, tuple(columns), tuple(rows), note))
    return tables


def _value_and_chance(result: StandardResult, budget: int | None, k: int) -> list[Cell]:
    pairs = result.pairs
    filled = _mean(pair.counts[budget] for pair in pairs)
    if filled is None or (budget is not None and filled < FILLED * budget):
        return [None, None, None]
    entries = [pair.repeatability[budget][k] for pair in pairs]
    value = _mean(entry.value for entry in entries)
    chance = _mean(entry.chance for entry in entries)
    assert value is not None
    assert chance is not None
    above = None if chance > SATURATED else (value - chance) / (1 - chance)
    return [value, chance, above]


def matching_table(results: Sequence[StandardResult], key: str, what: str) -> Table:
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
        judged = [pair.matches for pair in result.pairs]
        rows.append(
            (
                result.method.title,
                len(judged),
                _mean(pair.counts[MATCHING_BUDGET] for pair in result.pairs),
                _mean(one.matches for one in judged),
                *(_mean(one.correct[t - 1] for one in judged) for t in (1, 3)),
                *(_mean(one.precision(t) for one in judged) for t in (1, 3)),
                *(_mean(one.matching_score(t) for one in judged) for t in (1, 3)),
            )
        )
    return Table(f"{key}_matching", f"Matches, {what}", columns, tuple(rows), _matching_note())


def homography_table(results: Sequence[StandardResult], key: str, what: str) -> Table:
    """Tabulate the homographies that the matches give, with their spread over the seeds."""
    columns = [Column("method"), Column("pairs", ",d")]
    for threshold in CORNERS:
        columns += [
            Column(f"within {threshold:g} px", ".3f"),
            Column(f"± of {threshold:g} px", ".3f"),
        ]
    for threshold in CORNERS:
        columns += [
            Column(f"AUC at {threshold:g} px", ".3f"),
            Column(f"± of AUC {threshold:g}", ".3f"),
        ]
    rows: list[tuple[Cell, ...]] = []
    for result in results:
        seeds = [
            list(errors) for errors in zip(*(p.corner_errors for p in result.pairs), strict=True)
        ]
        cells: list[Cell] = [result.method.title, len(result.pairs)]
        for measure in (share_within, area_under_curve):
            for threshold in CORNERS:
                cells += _mean_and_spread(seeds, measure, threshold)
        rows.append(tuple(cells))
    note = (
        f"{_matching_note()} MAGSAC at {INLIER_THRESHOLD:g} px. Error: mean distance of the first "
        "image's corners from where the true homography takes them, at the images' own size; a "
        "pair without a homography counts as wrong. AUC: exact area under the share within a "
        f"threshold, up to it. Mean and standard deviation (±) over {SEEDS} seeds of MAGSAC."
    )
    title = f"Homographies, {what}"
    return Table(f"{key}_homography", title, tuple(columns), tuple(rows), note)


def _mean_and_spread(
    seeds: list[list[float]], measure: Callable[[Sequence[float], float], float], threshold: float
) -> list[Cell]:
    values = [measure(errors, threshold) for errors in seeds]
    return [float(np.mean(values)), float(np.std(values, ddof=1))] if values else [None, None]


def _matching_note() -> str:
    return (
        f"The best {MATCHING_BUDGET:,} keypoints of each image; the same upright RootSIFT of size "
        "4 for all, but for methods with descriptors of their own; mutual nearest neighbours, "
        f"ratio {RATIO} (none for learned descriptors). Means over the pairs; no matches count as "
        "a precision of 0."
    )


def accuracy_table(results: Sequence[StandardResult], key: str, what: str) -> Table:
    """Tabulate the mean matching accuracy at 1 to 10 px."""
    columns = (
        Column("method"),
        Column("pairs", ",d"),
        Column("matches", ",.0f"),
        *(Column(f"{t} px", ".3f") for t in range(1, 11)),
    )
    rows = tuple(
        (
            result.method.title,
            len(result.pairs),
            _mean(pair.all_matches.matches for pair in result.pairs),
            *(_accuracy(result) if result.pairs else (None,) * 10),
        )
        for result in results
    )
    note = (
        f"Mutual nearest neighbours of the best {MATCHING_BUDGET:,} keypoints, no ratio test for "
        "anyone: share of the matches that are at most so far off, mean over the pairs."
    )
    return Table(f"{key}_accuracy", f"Mean matching accuracy, {what}", columns, rows, note)


def accuracy_figure(results: Sequence[StandardResult], key: str, what: str) -> Figure:
    """Draw the mean matching accuracy."""
    lines = {
        result.method.title: (range(1, 11), _accuracy(result)) for result in results if result.pairs
    }
    png = line_chart(lines, "error up to, px", "mean matching accuracy")
    return Figure(f"{key}_accuracy", f"Mean matching accuracy, {what}", png)


def _accuracy(result: StandardResult) -> tuple[float, ...]:
    return mean_matching_accuracy([pair.all_matches for pair in result.pairs])


def cost_table(results: Sequence[StandardResult], key: str) -> Table:
    """Tabulate coverage, seconds and memory."""
    stages = ("detect", "describe", "match")
    budgets = _budgets(results)
    columns = (
        Column("method"),
        Column("pairs", ",d"),
        *(Column(f"coverage, {_name(budget)}", ".3f") for budget in budgets),
        *(Column(f"{stage}, s", ".3f") for stage in stages),
        *(Column(f"{stage}, MB", ",.0f") for stage in stages),
    )
    rows: list[tuple[Cell, ...]] = []
    for result in results:
        times: list[Cell] = []
        for stage in stages:
            taken = [pair.seconds[stage] for pair in result.pairs]
            known = taken and not (result.method.control and stage == "detect")
            times.append(float(np.median(taken)) if known else None)
        grown: list[Cell] = [
            max(pair.memory[stage] for pair in result.pairs) / 1e6 if result.pairs else None
            for stage in stages
        ]
        covered = [_mean(pair.coverage[b] for pair in result.pairs) for b in budgets]
        rows.append((result.method.title, len(result.pairs), *covered, *times, *grown))
    note = (
        "Coverage: share of the cells of 32x32 px that hold a keypoint of the first image. "
        "Seconds: the median when the results were made, on whatever the machine did then; "
        "detecting of one image, describing of both, matching of the pair at "
        f"{MATCHING_BUDGET:,} keypoints (`deepdetect benchmark speed` compares on equal terms). "
        "Memory: the largest growth of the process."
    )
    return Table(f"{key}_cost", "Coverage, time and memory", columns, tuple(rows), note)


def _budgets(results: Sequence[StandardResult]) -> list[int | None]:
    first: PairResult | None = next((pair for r in results for pair in r.pairs), None)
    return [] if first is None else list(first.coverage)


def _name(budget: int | None) -> str:
    return "all" if budget is None else f"{budget:,}"


def _mean(values) -> float | None:  # type: ignore[no-untyped-def]
    known = [value for value in values if value == value]
    return float(np.mean(known)) if known else None
