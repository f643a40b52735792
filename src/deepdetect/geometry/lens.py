"""Recognise lenses that bend straight lines, from the matches of two images.

A constraint x1^T B x0 = 0 and a homography are fitted to the matches, without distortion (B is then
a fundamental matrix) and with the division model (Fitzgibbon, "Simultaneous linear estimation of
multiple view geometry and lens distortion", 2001), which also fits fisheyes of over 180 degrees.
"""

from __future__ import annotations

import numpy as np

from .camera import Size

DISTORTIONS = (0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0, 1.3)
"""Distortions that are tried: the part of its distance by which a lens moves a corner inwards. At 1
it shows 180 degrees in the corners. An equidistant fisheye of 120 degrees has 0.4, one of 150
degrees 0.65. These are as dense as the fits can tell them apart."""

MIN_DISTORTION, MIN_DEVIATIONS = 0.2, 6.0
"""A lens with less distortion is no reason for an error: matches miss epipolar lines by few pixels.
It fits better if the mean cost of the matches falls by this number of standard deviations (Vuong's
test). The most for 201 pairs by pinholes are 4.3, of a street, and 1.9; fisheyes have up to 25."""

MIN_FLAT_DEVIATIONS, MIN_FLAT_RATIO, NEAR = 15.0, 2 / 3, 3.0
"""A distorted homography fits a plane or a camera that turned better by this number of deviations,
and fits at least this fraction of the matches that fit a pinhole's epipolar lines, within NEAR
times `SCALE`. A curved cloth has 8 and 0.55; the fisheyes found have 20 to 70 and 0.7 to 0.9."""

MIN_MATCHES = 30
"""No distortion is sought in fewer matches, because one may fit them by chance."""

UNDISTORT = "undistort them with the lens's calibration (cv2.undistort, cv2.fisheye)"

SCALE = 1e-3
SCALES = SCALE * np.array([16.0, 8, 4, 2, 1, 1, 1, 1, 1])
"""Scales of the Cauchy loss of successive fits, in half diagonals: the last is about one pixel of
images with 1200 columns. Wide scales first find a fit that is wrong at the border only."""


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
    xy = [
        (points - (np.array(size) - 1) / 2) / (np.hypot(*size) / 2)
        for points, size in zip((points0, points1), sizes, strict=True)
    ]
    found, straight, _ = _compared(xy, agreeing, False, MIN_DEVIATIONS)
    if found:
        return found
    found, _, bent = _compared(xy, agreeing, True, MIN_FLAT_DEVIATIONS)
    near = np.log1p(NEAR**2)
    most = np.count_nonzero(bent < near) >= MIN_FLAT_RATIO * np.count_nonzero(straight < near)
    return found if most else 0.0


def _compared(
    xy: list[np.ndarray], agreeing: np.ndarray, flat: bool, least: float
) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the distortion that fits better by `least` deviations, or 0, and costs without, with.

    `xy` are the positions from the middle of the image, in half diagonals.
    """
    straight = _costs(xy, 0.0, agreeing, SCALES, flat)
    bent = [_costs(xy, each, agreeing, SCALES, flat) for each in DISTORTIONS]
    best = int(np.argmin([costs.sum() for costs in bent]))
    if DISTORTIONS[best] < MIN_DISTORTION or deviations(straight, bent[best]) < least:
        return 0.0, straight, bent[best]
    for costs in bent:  # a pinhole may also fit, but only from where these fits have led
        for scales in (SCALES[1:], SCALES[4:]):
            again = _costs(xy, 0.0, np.exp(-costs), scales, flat)
            straight = min(straight, again, key=np.sum)
    # Something that moves by itself gets a fit of its own, so that it does not pass for a lens.
    several = [
        np.minimum(costs, _costs(xy, each, 1 - np.exp(-costs), SCALES, flat))
        for costs, each in ((straight, 0.0), (bent[best], DISTORTIONS[best]))
    ]
    clear = deviations(straight, bent[best]) >= least and deviations(*several) >= least
    return DISTORTIONS[best] if clear else 0.0, straight, bent[best]


def _costs(
    xy: list[np.ndarray], distortion: float, weights: np.ndarray, scales: np.ndarray, flat: bool
) -> np.ndarray:
    """Fit a constraint by iterated reweighting; return the (M,) costs at the scale `SCALE`."""
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
    """Return where (N, 3) rays are seen: the inverse of (x, y, 1 - distortion * r^2)."""
    ahead, side = rays[:, 2:], np.linalg.norm(rays[:, :2], axis=1, keepdims=True) + 1e-12
    root = np.sqrt(ahead**2 + 4 * distortion * side**2)
    return np.asarray(rays[:, :2] * 2 / np.maximum(ahead + root, 1e-6))
