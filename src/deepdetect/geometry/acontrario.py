"""Whether a geometry is more than chance: the number of false alarms of its inliers.

Moisan and Stival, "A probabilistic criterion to detect rigid point matches between two images and
estimate the fundamental matrix", 2004. Were all matches random, so many of them would agree so
well with the best of all models that can be drawn from them in so many such pairs of images.
"""

from __future__ import annotations

from math import lgamma, log, pi

import numpy as np

MAX_LOG10_NFA = -6.0
"""A geometry is trusted when fewer than 10 to this many random pairs would give its like."""

MINIMAL_SAMPLE_SIZE = {"homography": 4, "fundamental": 7}
"""Matches that a model is drawn from."""


def log10_nfa(errors: np.ndarray, model: str, threshold: float, size: tuple[int, int]) -> float:
    """Return the decimal logarithm of the number of false alarms.

    Args:
        errors: (M,) distances of all matches from the model, in pixels of the second image.
        model: "homography" or "fundamental".
        threshold: the matches nearer than this are its inliers.
        size: (width, height) of the second image.

    Returns:
        Below 0 for what chance does not do; infinite when there are too few inliers.

    Example:
        >>> near, far = np.zeros(30), np.full(70, 50.0)
        >>> log10_nfa(np.concatenate([near, far]), "homography", 3, (640, 480)) < -50
        True
        >>> log10_nfa(np.concatenate([near[:6], far]), "homography", 3, (640, 480)) > -6
        True
    """
    drawn = MINIMAL_SAMPLE_SIZE[model]
    count, inliers = len(errors), int(np.count_nonzero(errors < threshold))
    if inliers <= drawn:
        return float("inf")
    width, height = size
    if model == "homography":
        chance = pi * threshold**2 / (width * height)
    else:  # a band along a line through the image
        chance = 2 * threshold * float(np.hypot(width, height)) / (width * height)
    tests = log(count - drawn) + _choices(count, inliers) + _choices(inliers, drawn)
    return (tests + (inliers - drawn) * log(min(chance, 1.0))) / log(10)


def _choices(count: int, chosen: int) -> float:
    """Return the natural logarithm of the number of ways to choose."""
    return lgamma(count + 1) - lgamma(chosen + 1) - lgamma(count - chosen + 1)
