"""Recognise lenses that bend straight lines, from the matches of two images.

A constraint x1^T B x0 = 0 and a homography are fitted to the matches, without distortion (B is then
a fundamental matrix) and with the division model (Fitzgibbon, "Simultaneous linear estimation of
multiple view geometry and lens distortion", 2001), which also fits fisheyes of over 180 degrees.
"""

from __future__ import annotations

import numpy as np

from .camera import Size

DISTORTIONS = (0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0, 1.3)
"""Distortions that are tried: the fraction of its radius by which the lens moves a corner inwards.
At 1, the diagonal field of view is 180 degrees. An equidistant fisheye of 120 degrees has 0.4, one
of 150 degrees 0.65. Fits cannot tell denser values apart."""

MIN_DISTORTION, MIN_DEVIATIONS = 0.2, 6.0
"""Distortion below MIN_DISTORTION does no harm: matches miss epipolar lines by few pixels. A
distorted model fits better if the mean cost of matches falls by MIN_DEVIATIONS standard deviations
(Vuong's test). At most 4.3 was measured on 201 pairs of pinhole images, and 25 on fisheyes."""

MIN_FLAT_DEVIATIONS, NEAR = 12.0, 3.0
"""A distorted homography (a plane, a turned camera) must fit better by MIN_FLAT_DEVIATIONS, also if
multiplied by the ratio of its inliers (within NEAR * `SCALE`) to those of a fundamental matrix.
A bent cloth seen by a pinhole gets 16 * 0.56 = 9, a GoPro 15, a fisheye that turned 44."""

MIN_MATCHES = 30
"""Distortion is not estimated from fewer matches, because it may fit them by chance."""

UNDISTORT = "undistort them with the lens's calibration (cv2.undistort, cv2.fisheye)"

SCALE = 1e-3
SCALES = SCALE * np.array([16.0, 8, 4, 2, 1, 1, 1, 1, 1])
"""Scales of the Cauchy loss of successive fits, in half image diagonals; the last is about a pixel
of images with 1200 columns. The wide ones first find a fit that is wrong only at the border."""


def deviations(costs0: np.ndarray, costs1: np.ndarray) -> float:
    """Return by how many standard deviations the second model fits better (Vuong's test).

    The (N,) costs are of the same observations, under two models with equally many parameters.
    """
    falls = costs0 - costs1
    return float(falls.mean() / max(falls.std(), 1e-12) * np.sqrt(len(falls)))


def distortion(
    points0: np.ndarray, points1: np.ndarray, agreeing: np.ndarray, sizes: tuple[Size, Size]
) -> float:
    """Return the distortion in `DISTORTIONS` that fits matches clearly better than none, or else 0.

    Many of the (M, 2) matches may be wrong; `agreeing`, (M,) bool, are inliers of a pinhole model.
    """
    if len(points0) < MIN_MATCHES:
        return 0.0
    xy = [
        (points - (np.array(size) - 1) / 2) / (np.hypot(*size) / 2)
        for points, size in zip((points0, points1), sizes, strict=True)
    ]
    found, straight, _ = _compared(xy, agreeing, False, MIN_DEVIATIONS)
    if found:
        return found
    found, flat, bent = _compared(xy, agreeing, True, MIN_FLAT_DEVIATIONS)
    lines, most = (np.count_nonzero(costs < np.log1p(NEAR**2)) for costs in (straight, bent))
    return found if deviations(flat, bent) * most >= MIN_FLAT_DEVIATIONS * lines else 0.0


def _compared(
    xy: list[np.ndarray], agreeing: np.ndarray, flat: bool, least: float
) -> tuple[float, np.ndarray, np.ndarray]:
    """Return a distortion that fits `least` deviations better, or 0; costs without and with it.

    `xy` are positions relative to the middle of the image, in half diagonals.
    """
    straight = _costs(xy, 0.0, agreeing, SCALES, flat)
    bent = [_costs(xy, each, agreeing, SCALES, flat) for each in DISTORTIONS]
    best = int(np.argmin([costs.sum() for costs in bent]))
    if DISTORTIONS[best] < MIN_DISTORTION or deviations(straight, bent[best]) < least:
        return 0.0, straight, bent[best]
    for costs in bent:  # a pinhole may fit as well, starting from the weights of these fits
        for scales in (SCALES[1:], SCALES[4:]):
            again = _costs(xy, 0.0, np.exp(-costs), scales, flat)
            straight = min(straight, again, key=np.sum)
    # A moving object gets a fit of its own, so that it is not mistaken for lens distortion.
    several = [
        np.minimum(costs, _costs(xy, each, 1 - np.exp(-costs), SCALES, flat))
        for costs, each in ((straight, 0.0), (bent[best], DISTORTIONS[best]))
    ]
    clear = deviations(straight, bent[best]) >= least and deviations(*several) >= least
    return DISTORTIONS[best] if clear else 0.0, straight, bent[best]


def _costs(
    xy: list[np.ndarray], distortion: float, weights: np.ndarray, scales: np.ndarray, flat: bool
) -> np.ndarray:
    """Fit x1^T B x0 = 0 (if `flat`, a homography) robustly; return (M,) Cauchy costs at `SCALE`."""
    first, second = (np.column_stack([p, 1 - distortion * (p**2).sum(axis=1)]) for p in xy)
    products = second[:, :, None] * first[:, None, :]
    if flat:  # second is parallel to H first
        x, y, z = products.transpose(1, 0, 2)
        rows = np.hstack([np.zeros_like(x), -z, y, z, np.zeros_like(x), -x]).reshape(-1, 2, 9)
    else:  # second^T B first = 0
        rows = products.reshape(-1, 1, 9)
    weights = weights + 1e-6
    for scale in scales:
        weighted = (rows * weights[:, None, None]).reshape(-1, 9)
        matrix = np.linalg.eigh(weighted.T @ rows.reshape(-1, 9))[1][:, 0].reshape(3, 3)
        if flat:
            rays = first @ matrix.T * np.sign(np.median((first @ matrix.T * second)[:, 2]))
            squares = (rays**2).sum(axis=1) * (second**2).sum(axis=1)
            errors = ((_distorted(rays, distortion) - xy[1]) ** 2).sum(axis=1)
        else:
            squares = np.full(len(first), 1e-30)
            for line, p in zip((second @ matrix, first @ matrix.T), xy, strict=True):
                squares += ((line[:, :2] - 2 * distortion * line[:, 2:] * p) ** 2).sum(axis=1)
            errors = (rows[:, 0] @ matrix.ravel()) ** 2 / squares  # squared Sampson distances
        weights = 1 / (squares * (1 + errors / scale**2))
        weights /= weights.mean()
    return np.log1p(errors / SCALE**2)


def _distorted(rays: np.ndarray, distortion: float) -> np.ndarray:
    """Project (N, 3) rays and distort them: the inverse of (x, y, 1 - distortion * r^2)."""
    ahead, side = rays[:, 2:], np.linalg.norm(rays[:, :2], axis=1, keepdims=True) + 1e-12
    root = np.sqrt(ahead**2 + 4 * distortion * side**2)
    return np.asarray(rays[:, :2] * 2 / np.maximum(ahead + root, 1e-6))
