"""A contrario validation: whether a geometry has more inliers than chance explains.

Moisan and Stival, "A probabilistic criterion to detect rigid point matches between two images and
estimate the fundamental matrix", 2004. The number of false alarms (NFA) of a geometry is how many
models with as many inliers at this threshold are expected among random matches.
"""

from __future__ import annotations

from math import lgamma, log, pi

import numpy as np

MAX_LOG10_NFA = -6.0
"""A geometry is accepted below this decimal logarithm of its number of false alarms."""

MINIMAL_SAMPLE_SIZE = {"homography": 4, "fundamental": 7, "essential": 5}
"""Matches that determine a model."""


def log10_nfa(
    inliers: np.ndarray,
    model: str,
    inlier_threshold: float,
    image_size: tuple[int, int],
    models_per_sample: int = 1,
) -> float:
    """Return the decimal logarithm of the number of false alarms.

    Args:
        inliers: (M,) bool, which of all matches are near the model.
        model: "homography", "fundamental" or "essential".
        inlier_threshold: that they are nearer than, in pixels of the second image.
        image_size: (width, height) of the second image.
        models_per_sample: that were tried for each minimal sample.

    Returns:
        Below 0 for what chance does not explain; infinite when there are too few inliers.

    Example:
        >>> log10_nfa(np.arange(100) < 30, "homography", 3, (640, 480)) < -50
        True
        >>> log10_nfa(np.arange(76) < 6, "homography", 3, (640, 480)) > -6
        True
    """
    sample = MINIMAL_SAMPLE_SIZE[model]
    count, agreeing = len(inliers), int(np.count_nonzero(inliers))
    if agreeing <= sample:
        return float("inf")
    width, height = image_size
    if model == "homography":
        chance = pi * inlier_threshold**2 / (width * height)
    else:  # a band along a line through the image
        chance = 2 * inlier_threshold * float(np.hypot(width, height)) / (width * height)
    tests = log(models_per_sample * (count - sample))
    tests += log_binomial(count, agreeing) + log_binomial(agreeing, sample)
    return (tests + (agreeing - sample) * log(min(chance, 1.0))) / log(10)


def log_binomial(count: int, chosen: int) -> float:
    """Return the natural logarithm of a binomial coefficient."""
    return lgamma(count + 1) - lgamma(chosen + 1) - lgamma(count - chosen + 1)
