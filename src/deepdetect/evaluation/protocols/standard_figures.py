"""The figures of the standard protocol; their numbers are in its tables."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ..charts import line_chart, scatter_chart
from ..report import Figure
from .standard_results import MATCHING_BUDGET, RADII_PX, FeatureResult
from .standard_tables import mean_accuracy


def accuracy_figure(results: Sequence[FeatureResult], key: str, what: str) -> Figure:
    """Draw the mean matching accuracy."""
    lines = {
        result.feature.title: (range(1, 11), mean_accuracy(result))
        for result in results
        if result.pairs
    }
    png = line_chart(lines, "error up to, px", "mean matching accuracy")
    return Figure(f"{key}_accuracy", f"Mean matching accuracy, {what}", png)


def repeatability_figure(
    results: Sequence[FeatureResult],
    k: int,
    key: str,
    what: str,
    budgets: Sequence[int | None],
) -> Figure:
    """Draw the repeatability at `RADII_PX[k]` against the number of keypoints.

    Of rows with the same keypoints, which differ in their descriptors, the first one is drawn.
    """
    numbers = [budget for budget in budgets if budget is not None]
    lines = {}
    drawn: set[str] = set()
    for result in results:
        if result.feature.detection in drawn:
            continue
        drawn.add(result.feature.detection)
        found = [result.repeatability(budget, k) for budget in numbers]
        if any(found):
            values = [one[0] if one else math.nan for one in found]
            lines[result.feature.title] = (numbers, values)
    label = f"mutual-NN repeatability within {RADII_PX[k]:g} px"
    png = line_chart(lines, "keypoints per image", label, logarithmic=True)
    title = f"Repeatability within {RADII_PX[k]:g} px against the number of keypoints, {what}"
    return Figure(f"{key}_repeatability_{RADII_PX[k]:g}px", title, png)


def time_figure(results: Sequence[FeatureResult], key: str, what: str) -> Figure:
    """Draw the correct matches against the time of a pair."""
    points = {}
    for result in results:
        seconds, correct = result.median_seconds(), result.correct()
        if seconds and correct is not None:
            points[result.feature.title] = (seconds, correct)
    label = f"correct matches at 1 px of {MATCHING_BUDGET:,} keypoints"
    x_label = "detecting, describing and matching a pair, s"
    png = scatter_chart(points, x_label, label, logarithmic=True)
    return Figure(f"{key}_time", f"Time against correct matches, {what}", png)
