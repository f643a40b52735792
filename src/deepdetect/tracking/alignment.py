"""Find patches of one image in later images, under an affine deformation, by Gauss-Newton.

The method is inverse compositional (Baker and Matthews, "Lucas-Kanade 20 years on", 2004): each
iteration computes only the residuals anew. Gain and offset of the brightness are eliminated.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from .._shared.opencv import cv2

RADIUS_PX = 10
"""A patch is a square that extends this far from its central pixel. Its pixels have Gaussian
weights with half of this distance as sigma. Chosen by hand."""

BLUR_SIGMA_PX = 1.0
"""Images are blurred with this sigma, so that values between pixels can be interpolated well."""

BORDER_PX = 3
"""An image border of this width is not used, because blurred values there depend on padding."""

MAX_ITERATIONS = 30
CONVERGENCE_PX = 0.03
"""A patch that moves by less than this in an iteration has converged. A smaller limit would not
help, because OpenCV 4 interpolates images at steps of 1/32 px."""

MAX_SHIFT_PX = 3.0
"""A patch is searched up to this distance from its expected position, because tracking by
translation alone can be wrong by that much where surfaces come nearer. Chosen by hand."""

MIN_CORRELATION = 0.8
"""A patch counts as found if its correlation with the image is at least this. Chosen by hand."""

MAX_GROWTH = 4.0
"""The area of a patch may grow or shrink by at most this factor, because otherwise one image shows
the patch on too few pixels. Chosen by hand."""

RIDGE = 1e-4
"""This multiple of the mean squared gradient is added to the diagonal of the normal equations,
because they are singular for a patch that shows only parallel edges. Chosen by hand."""

MOST_READ = 1 << 14
"""OpenCV limits the sides of images to 32,767 px, so at most this many patches are read at once."""


class Patches(NamedTuple):
    """N patches of P pixels each: float32 values (N, P), steps (N, 6, P) and variances (N,).

    The steps of a patch map its P residuals to changes of its position (2 numbers) and of its
    deformation (4 numbers, row by row). `affinities` (N, 2, 2) float64 map offsets of pixels from
    the centre of a patch to offsets in the image in which the patch was last found.
    """

    values: np.ndarray
    steps: np.ndarray
    variances: np.ndarray
    affinities: np.ndarray

    @classmethod
    def none(cls) -> Patches:
        """Return an empty set of patches."""
        pixels = (2 * RADIUS_PX + 1) ** 2
        values = np.empty((0, pixels), np.float32)
        steps = np.empty((0, 6, pixels), np.float32)
        return cls(values, steps, np.empty(0, np.float32), np.empty((0, 2, 2)))

    def select(self, rows: np.ndarray) -> Patches:
        """Return some of the patches; `rows` is a boolean mask or indices."""
        return Patches(*(each[rows] for each in self))


def cut_patches(image: np.ndarray, xy: np.ndarray) -> Patches:
    """Return patches around (N, 2) points of a blurred image.

    The values of patches too near to the image border are 0, so these patches are never found.
    """
    offsets, weights = _pixels()
    affinities = np.tile(np.eye(2), (len(xy), 1, 1))
    slopes = [
        _read(cv2.Sobel(image, cv2.CV_32F, *axis, ksize=1, scale=0.5), xy, affinities)
        for axis in ((1, 0), (0, 1))
    ]
    slope = np.stack(slopes, axis=1)
    deformation = (slope[:, :, None] * offsets).reshape(len(xy), 4, -1)
    changes = _centred(np.concatenate([slope, deformation], axis=1))
    margin = RADIUS_PX + BORDER_PX
    most = np.array(image.shape[::-1]) - 1 - margin
    inside = np.all((xy >= margin) & (xy <= most), axis=1)
    values = _centred(_read(image, xy, affinities)) * inside[:, None]
    variances = np.maximum((values**2) @ weights, 1e-6)
    by_gain = changes @ (values * weights)[..., None] / variances[:, None, None]
    changes -= by_gain * values[:, None]
    weighted = changes * weights
    normal = weighted @ changes.transpose(0, 2, 1)
    scale = (slope**2 @ weights).sum(axis=1) + 1e-6
    ridge = RIDGE * np.diag([1.0] * 2 + [weights @ offsets[0] ** 2] * 4)
    normal += scale[:, None, None] * ridge
    steps = np.linalg.inv(normal).astype(np.float32) @ weighted
    return Patches(values, steps, variances, affinities)


def find_patches(
    image: np.ndarray, patches: Patches, xy: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find patches in a blurred image near (N, 2) expected positions.

    Returns the (N, 2) positions and (N, 2, 2) affinities of the patches, float64, and (N,) bool:
    whether each patch was found. If it was not, its position and affinity are meaningless.
    """
    found, affinities = xy.astype(np.float64), patches.affinities.copy()
    arrived = np.zeros(len(xy), bool)
    rows = np.arange(len(xy))
    most = np.array(image.shape[::-1]) - 1
    weights = _pixels()[1]
    for _ in range(MAX_ITERATIONS):
        spread = RADIUS_PX * np.abs(affinities[rows]).sum(axis=2) + BORDER_PX
        rows = rows[((found[rows] >= spread) & (found[rows] <= most - spread)).all(axis=1)]
        if not len(rows):
            break
        values, steps, variances, _ = patches.select(rows)
        seen = _centred(_read(image, found[rows], affinities[rows]))
        shared = (seen * values) @ weights
        correlation = shared / np.sqrt(np.maximum((seen**2) @ weights, 1e-6) * variances)
        step = (steps @ seen[..., None])[..., 0] * (variances / np.maximum(shared, 1e-6))[:, None]
        deformed = np.eye(2) + step[:, 2:].reshape(-1, 2, 2)
        regular = (shared > 0) & (np.linalg.det(deformed) > 1 / MAX_GROWTH)
        rows, step, correlation = rows[regular], step[regular], correlation[regular]
        affinities[rows] @= np.linalg.inv(deformed[regular])
        found[rows] -= (affinities[rows] @ step[:, :2, None])[..., 0]
        near = np.linalg.norm(found[rows] - xy[rows], axis=1) <= MAX_SHIFT_PX
        still = np.linalg.norm(step[:, :2], axis=1) < CONVERGENCE_PX
        arrived[rows[near & still & (correlation >= MIN_CORRELATION)]] = True
        rows = rows[near & ~still]
    growth = np.linalg.det(affinities)
    return found, affinities, arrived & (growth > 1 / MAX_GROWTH) & (growth < MAX_GROWTH)


@cache
def _pixels() -> tuple[np.ndarray, np.ndarray]:
    """Return the offsets of a patch's pixels from its centre, (2, P), and their weights, (P,)."""
    offsets = np.indices((2 * RADIUS_PX + 1,) * 2, np.float32)[::-1].reshape(2, -1) - RADIUS_PX
    weights = np.exp(-2 * (offsets**2).sum(axis=0) / RADIUS_PX**2)
    return offsets, weights / weights.sum()


def _read(image: np.ndarray, xy: np.ndarray, affinities: np.ndarray) -> np.ndarray:
    """Return the (N, P) values of an image at the pixels of N patches warped by the affinities."""
    # Lanczos interpolation is used, because OpenCV's cubic kernel shifts by up to 0.05 px.
    places = xy.astype(np.float32)[:, :, None] + affinities.astype(np.float32) @ _pixels()[0]
    parts = np.array_split(places, len(places) // MOST_READ + 1)
    return np.concatenate(
        [cv2.remap(image, *part.transpose(1, 0, 2), cv2.INTER_LANCZOS4) for part in parts]
    )


def _centred(values: np.ndarray) -> np.ndarray:
    """Subtract the weighted mean of each patch."""
    return values - (values @ _pixels()[1])[..., None]
