"""What the standard protocol measures: results of pairs and features, and how they are averaged."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..baselines.method import LocalFeature
from ..metrics.matching import MatchAccuracy
from ..metrics.repeatability import Repeatability
from ..profiling import Profile
from ..report import Cell, Column, Table

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
        kind: what changes between the two images, "" where the data set does not say.
    """

    repeatability: Mapping[int | None, list[Repeatability]]
    coverage: Mapping[int | None, float]
    counts: Mapping[int | None, int]
    matches: MatchAccuracy
    all_matches: MatchAccuracy
    corner_errors_px: list[float]
    profiles: Mapping[str, Profile]
    kind: str = ""

    @property
    def seconds(self) -> float:
        """Of detecting in both images (twice the first), describing both, and matching."""
        detect, describe, match = (self.profiles[stage].seconds for stage in PROFILED_STAGES)
        return 2 * detect + describe + match


@dataclass(frozen=True)
class FeatureResult:
    """What one feature gives on the pairs that could be measured."""

    feature: LocalFeature
    pairs: list[PairResult]

    def mean(self, value: Callable[[PairResult], float]) -> float | None:
        """Average a value over the pairs where it is not NaN."""
        return _mean(value(pair) for pair in self.pairs)

    def repeatability(self, budget: int | None, k: int) -> tuple[float, float] | None:
        """Return the repeatability at `RADII_PX[k]` and its chance; None if it is not filled."""
        filled = self.mean(lambda pair: pair.counts[budget])
        if filled is None or (budget is not None and filled < MIN_FILLED * budget):
            return None
        entries = [pair.repeatability[budget][k] for pair in self.pairs]
        value, chance = ([getattr(e, name) for e in entries] for name in ("value", "chance"))
        return float(np.mean(value)), float(np.mean(chance))

    def correct(self, threshold_px: int = 1) -> float | None:
        """Return the mean number of correct matches."""
        return self.mean(lambda pair: pair.matches.correct[threshold_px - 1])

    def median_seconds(self) -> float | None:
        """Return the median time of a pair; None where the time of detecting means nothing."""
        if self.feature.chance or not self.pairs:
            return None
        return float(np.median([pair.seconds for pair in self.pairs]))

    def of_kind(self, kind: str) -> FeatureResult:
        """Return the result on the pairs of a kind."""
        return FeatureResult(self.feature, [pair for pair in self.pairs if pair.kind == kind])


Columns = Sequence[tuple[Column, Callable[[FeatureResult], Cell]]]


def tabulate(
    results: Sequence[FeatureResult], key: str, title: str, columns: Columns, note: str
) -> Table:
    """Make a table with a row for each feature."""
    heads = (Column("method"), Column("pairs", ",d"), *(column for column, _ in columns))
    rows = (
        (one.feature.title, len(one.pairs), *(cell(one) for _, cell in columns)) for one in results
    )
    return Table(key, title, heads, tuple(rows), note)


def budget_name(budget: int | None) -> str:
    """Return how tables name a budget."""
    return "all" if budget is None else f"{budget:,}"


def _mean(values: Iterable[float]) -> float | None:
    known = [value for value in values if value == value]
    return float(np.mean(known)) if known else None
