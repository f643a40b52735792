"""Find patches of one image in later images, under an affine deformation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .._shared.opencv import cv2
from ..geometry.alignment import Alignment, align_patches

ALIGNMENT = Alignment(radius_px=10, max_shift_px=3.0, convergence_px=0.03, affine=True)
"""How patches are aligned. Tracking by translation alone can be wrong by up to 3 pixels where
surfaces come nearer. Chosen by hand."""

KEPT_PX = ALIGNMENT.radius_px + 3
"""A patch is kept with 3 more pixels on each side, which interpolation reads."""

BLUR_SIGMA_PX = 1.0
"""Images are blurred with this sigma, so that values between pixels can be interpolated well."""

MAX_GROWTH = 4.0
"""The area of a patch may grow or shrink by at most this factor, because otherwise one image shows
the patch on too few pixels. Chosen by hand."""

MOST_READ = 1 << 14
"""OpenCV limits the sides of images to 32,767 px, so at most this many patches are read at once."""


class Patches(NamedTuple):
    """N patches: (N, S, S) float32 pixels around their centres.

    The (N, 2, 2) float64 `affinities` map offsets of pixels from the centre of a patch to offsets
    in the image in which the patch was last found.
    """

    pixels: np.ndarray
    affinities: np.ndarray

    @classmethod
    def none(cls) -> Patches:
        """Return an empty set of patches."""
        return cls(np.empty((0, 2 * KEPT_PX + 1, 2 * KEPT_PX + 1), np.float32), np.empty((0, 2, 2)))

    def select(self, rows: np.ndarray) -> Patches:
        """Return some of the patches; `rows` is a boolean mask or indices."""
        return Patches(*(each[rows] for each in self))


def cut_patches(image: np.ndarray, xy: np.ndarray) -> Patches:
    """Return patches around (N, 2) points of a blurred image.

    The pixels of patches too near to the image border are 0, so these patches are never found.
    """
    steps = np.arange(-KEPT_PX, KEPT_PX + 1, dtype=np.float32)
    offsets = np.stack(np.meshgrid(steps, steps)).reshape(2, -1)
    places = xy.astype(np.float32)[:, :, None] + offsets
    # Lanczos interpolation is used, because OpenCV's cubic kernel shifts by up to 0.05 px.
    pixels = np.concatenate(
        [
            cv2.remap(image, *part.transpose(1, 0, 2), cv2.INTER_LANCZOS4)
            for part in np.array_split(places, len(places) // MOST_READ + 1)
        ]
    )
    most = np.array(image.shape[::-1]) - 1 - KEPT_PX
    inside = np.all((xy >= KEPT_PX) & (xy <= most), axis=1)
    pixels = (pixels * inside[:, None]).reshape(-1, len(steps), len(steps))
    return Patches(pixels, np.tile(np.eye(2), (len(xy), 1, 1)))


def find_patches(
    image: np.ndarray, patches: Patches, xy: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find patches in a blurred image near (N, 2) expected positions.

    Returns the (N, 2) positions and (N, 2, 2) affinities of the patches, float64, and (N,) bool:
    whether each patch was found. If it was not, its position and affinity are meaningless.
    """
    count, side, _ = patches.pixels.shape
    centres = np.column_stack([np.full(count, KEPT_PX), np.arange(count) * side + KEPT_PX])
    column = patches.pixels.reshape(-1, side)  # all patches, one above the other
    aligned = align_patches((column, image), centres, xy, patches.affinities, ALIGNMENT)
    growth = np.linalg.det(aligned.affinities)
    regular = (growth > 1 / MAX_GROWTH) & (growth < MAX_GROWTH)
    return aligned.points1, aligned.affinities, aligned.converged & regular
