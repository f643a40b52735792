"""The compiled part of `orientation`. Importing it needs numba; the first call compiles."""

from __future__ import annotations

import numpy as np

from .._shared.kernels import compiled

BINS = 36
WINDOW_PER_SIGMA = 1.5
"""Sigma of the Gaussian window over that of the keypoint."""

RADIUS_PER_WINDOW = 3.0


@compiled(nogil=True, fastmath=True)
def vote(start, stop, magnitude, bins, places, sigmas, out):  # type: ignore[no-untyped-def]
    """Find the dominant orientations of the keypoints from `start` to before `stop`.

    Args:
        start, stop: rows of the keypoints.
        magnitude: (H, W) float32 of the gradient.
        bins: (H, W) uint8 directions of the gradient in units of 10 degrees, 36 is 0 again.
        places: (N, 2) int64 pixels.
        sigmas: (N,) float64 of the keypoints in pixels.
        out: (N,) float32 degrees, written.
    """
    height, width = magnitude.shape
    raw = np.zeros(BINS + 4, np.float64)
    smooth = np.zeros(BINS, np.float64)
    for k in range(start, stop):
        window = WINDOW_PER_SIGMA * sigmas[k]
        radius = round(RADIUS_PER_WINDOW * window)
        weights = np.empty(radius + 1, np.float64)
        for i in range(radius + 1):
            weights[i] = np.exp(-0.5 * (i / window) ** 2)
        raw[:] = 0
        x0, y0 = places[k]
        for y in range(max(y0 - radius, 1), min(y0 + radius + 1, height - 1)):
            of_row = weights[abs(y - y0)]
            for x in range(max(x0 - radius, 1), min(x0 + radius + 1, width - 1)):
                raw[bins[y, x] % BINS + 2] += of_row * weights[abs(x - x0)] * magnitude[y, x]
        raw[0], raw[1], raw[BINS + 2], raw[BINS + 3] = raw[BINS], raw[BINS + 1], raw[2], raw[3]
        best = 0
        for i in range(BINS):
            near, far = raw[i + 1] + raw[i + 3], raw[i] + raw[i + 4]
            smooth[i] = (6 * raw[i + 2] + 4 * near + far) / 16
            if smooth[i] > smooth[best]:
                best = i
        left, middle, right = smooth[best - 1], smooth[best], smooth[(best + 1) % BINS]
        curvature = left - 2 * middle + right
        shift = 0.5 * (left - right) / curvature if curvature < 0 else 0.0
        degrees = (best + shift) * 360 / BINS
        out[k] = degrees + 360 if degrees < 0 else degrees
        if out[k] >= 360:
            out[k] = 0
