"""Recognise lenses that bend straight lines, from the matches of two images.

A bilinear constraint x1^T B x0 = 0 is fitted to the matches, without distortion (B is then a
fundamental matrix) and with the division model (Fitzgibbon, "Simultaneous linear estimation of
multiple view geometry and lens distortion", 2001), which also fits fisheyes of over 180 degrees.
"""

from __future__ import annotations

import numpy as np

from .camera import Size
from .two_view import MIN_MATCHES

DISTORTIONS = (0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0, 1.3)
"""Distortions that are tried: the part of its distance by which a lens moves a corner inwards. At 1
it shows 180 degrees in the corners. An equidistant fisheye of 120 degrees has 0.4, one of 150
degrees 0.65. These are as dense as the fits can tell them apart."""

MIN_DISTORTION = 0.2
"""A lens with less distortion is no reason for an error: matches then miss epipolar lines by few
pixels. It is 0.15 or less for photographs, and 0.2 for stereo cameras with k1 = -0.3."""

MIN_DEVIATIONS = 6.0
"""A lens fits better if the mean cost of the matches falls by this number of standard deviations
(Vuong's test). The largest of 201 pairs by pinholes is 4.3, in a street with moving clouds, and the
second 1.9. Fisheyes reach 5 to 30."""

UNDISTORT = "undistort them with the lens's calibration (cv2.undistort, cv2.fisheye)"

SCALE = 1e-3
"""Scale of the Cauchy loss, in half diagonals: about one pixel of images with 1200 columns."""

SCALES = SCALE * np.array([16.0, 8, 4, 2, 1, 1, 1, 1, 1])
"""Scales of successive fits; wide scales first find a fit that is wrong at the border only."""


def deviations(costs0: np.ndarray, costs1: np.ndarray) -> float:
    """Return by how many standard deviations the second model fits better (Vuong's test).

    Both are (N,) costs of the same observations, under two models with equally many parameters.
    """
    falls = costs0 - costs1
    return float(falls.mean() / max(falls.std(), 1e-12) * np.sqrt(len(falls)))


def distortion(
    points0: np.ndarray, points1: np.ndarray, agreeing: np.ndarray, sizes: tuple[Size, Size]
) -> float:
    """Return one of `DISTORTIONS` that fits (M, 2) matches clearly better than none, otherwise 0.

    Many matches may be wrong; `agreeing` is (M,) bool, true for those with a pinhole geometry.
    """
    if len(points0) < MIN_MATCHES:
        return 0.0
    normalised = [
        (points - (np.array(size) - 1) / 2) / (np.hypot(*size) / 2)
        for points, size in zip((points0, points1), sizes, strict=True)
    ]
    straight = _costs(normalised, 0.0, agreeing, SCALES)
    bent = [_costs(normalised, each, agreeing, SCALES) for each in DISTORTIONS]
    best = int(np.argmin([costs.sum() for costs in bent]))
    if DISTORTIONS[best] < MIN_DISTORTION or deviations(straight, bent[best]) < MIN_DEVIATIONS:
        return 0.0
    for costs in bent:  # a pinhole may also fit, but only from where these fits have led
        for scales in (SCALES[1:], SCALES[4:]):
            again = _costs(normalised, 0.0, np.exp(-costs), scales)
            straight = min(straight, again, key=np.sum)
    clear = deviations(straight, bent[best]) >= MIN_DEVIATIONS
    return DISTORTIONS[best] if clear else 0.0


def _costs(
    normalised: list[np.ndarray], distortion: float, weights: np.ndarray, scales: np.ndarray
) -> np.ndarray:
    """Fit the constraint by iterated reweighting; return the (M,) costs at the scale `SCALE`."""
    lifted = [np.column_stack([xy, 1 - distortion * (xy**2).sum(axis=1)]) for xy in normalised]
    rows = (lifted[1][:, :, None] * lifted[0][:, None, :]).reshape(-1, 9)
    weights = weights + 1e-6
    for scale in scales:
        vector = np.linalg.eigh(rows.T @ (rows * weights[:, None]))[1][:, 0]
        matrix, squares = vector.reshape(3, 3), np.full(len(rows), 1e-30)
        lines = lifted[1] @ matrix, lifted[0] @ matrix.T
        for line, xy in zip(lines, normalised, strict=True):
            squares += ((line[:, :2] - 2 * distortion * line[:, 2:] * xy) ** 2).sum(axis=1)
        errors = (rows @ vector) ** 2 / squares  # squared Sampson distances
        weights = 1 / (squares * (1 + errors / scale**2))
        weights /= weights.mean()
    return np.log1p(errors / SCALE**2)
