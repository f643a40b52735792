"""The true disparities of a stereo scene, and whether they belong to its photographs.

A disparity map is of one view. One of another view of the same row of cameras fits the photographs
badly, and far better when it is moved to theirs; then points are judged by both, and the report
says so.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...datasets.middlebury import load_middlebury
from ...datasets.types import StereoPair
from ...io.image import luma

BETTER = 0.7
"""A truth that is moved is taken when the photographs then differ by less than this share."""

STEPS = (-4, -3, -2, -1, 1, 2, 3, 4)
"""Baselines that the truth may be aside."""

AS_IT_IS = ""
MOVED = "truth moved to its photographs"


def truths(scene: Path) -> dict[str, np.ndarray]:
    """Return the true disparities of a scene by name: "" as its file has it, and perhaps moved.

    Raises:
        ImageError: the scene has no truth.
    """
    pair = load_middlebury(scene)
    found = {AS_IT_IS: pair.disparity}
    baselines = baselines_aside(pair)
    if baselines:
        found[MOVED] = moved(pair.disparity, baselines)
    return found


def baselines_aside(pair: StereoPair) -> int:
    """Return how many baselines to the left of the left image the truth was seen from.

    0 unless the photographs fit a moved truth far better (`BETTER`).
    """
    as_it_is = unlike(pair, pair.disparity)
    others = {step: unlike(pair, moved(pair.disparity, step)) for step in STEPS}
    best = min(others, key=lambda step: others[step])
    return best if others[best] < BETTER * as_it_is else 0


def unlike(pair: StereoPair, disparity: np.ndarray) -> float:
    """Return the mean difference of the luma of what a disparity says are the same places."""
    left, right = (luma(image).astype(np.float32) for image in (pair.left, pair.right))
    rows, columns = np.nonzero(np.isfinite(disparity))
    there = columns - disparity[rows, columns]
    inside = (there >= 0) & (there <= left.shape[1] - 1)
    if not inside.any():
        return float("inf")
    rows, columns, there = rows[inside], columns[inside], there[inside]
    before = np.floor(there).astype(np.int64)
    after = np.minimum(before + 1, left.shape[1] - 1)
    share = there - before
    seen = (1 - share) * right[rows, before] + share * right[rows, after]
    return float(np.abs(left[rows, columns] - seen).mean())


def moved(disparity: np.ndarray, baselines: int) -> np.ndarray:
    """Show a disparity map from a view so many baselines to the right; NaN where that is hidden.

    Where several places fall on one pixel the nearest of them is seen.

    Example:
        >>> moved(np.array([[np.nan, np.nan, 1.0, 1.0, 2.0]]), 1).tolist()
        [[nan, 1.0, 2.0, nan, nan]]
    """
    rows, columns = np.nonzero(np.isfinite(disparity))
    values = disparity[rows, columns]
    columns = np.rint(columns - baselines * values).astype(np.int64)
    inside = (columns >= 0) & (columns < disparity.shape[1])
    out = np.full(disparity.shape, -np.inf, np.float32)
    np.maximum.at(out, (rows[inside], columns[inside]), values[inside])
    return np.where(np.isfinite(out), out, np.nan).astype(np.float32)
