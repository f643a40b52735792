"""Laying one photograph onto another: the direct use of guided matching."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import cv2
import numpy as np

from .._shared.errors import DeepDetectError, OptionError
from ..geometry import GeometryOptions
from ..geometry.zncc import agreement
from ..io.image import load_image, luma
from .pipeline import HeatmapDetector, match_images

SQUARES = 8
"""Squares of the checkerboard along the shorter side."""

FIXED = {"guidance", *(field.name for field in fields(GeometryOptions))} - {"seed"}
"""Options of `match_images` that a registration does not take: it is by a homography."""


@dataclass(frozen=True, eq=False)
class Registration:
    """A second image in the frame of a first.

    Attributes:
        homography: (3, 3) from the first image to the second.
        first: (H, W, 3) uint8 RGB, the first image.
        warped: (H, W, 3) uint8 RGB, the second in its frame, black where it has nothing.
        seen: (H, W) bool, where it has something.
        matches: number of dense matches that hold.
        agreement: median local correlation of the two over what both show, in [-1, 1].
    """

    homography: np.ndarray
    first: np.ndarray
    warped: np.ndarray
    seen: np.ndarray
    matches: int
    agreement: float

    def checkerboard(self) -> np.ndarray:
        """Return both images in turn, in squares: edges go on where they fit; (H, W, 3) uint8."""
        height, width = self.seen.shape
        side = max(1, min(height, width) // SQUARES)
        row, column = np.indices((height, width)) // side
        second = self.seen & ((row + column) % 2 == 1)
        return np.where(second[..., None], self.warped, self.first)

    def difference(self) -> np.ndarray:
        """Return how far apart the colours are, 0 where only one has something; (H, W, 3) uint8."""
        return np.where(self.seen[..., None], cv2.absdiff(self.first, self.warped), 0)


def register(
    image0: Any, image1: Any, detector: HeatmapDetector | None = None, **changes: Any
) -> Registration:
    """Find the homography of two images and lay the second onto the first.

    For planes, and for photographs from one place. The homography comes from few points, is
    sharpened by the images and confirmed by the dense matches (`guidance`).

    Args:
        image0, image1: anything `DeepDetect.heatmap` takes.
        detector: as of `match_images`.
        **changes: options of `match_images`, but for `guidance` and those of the geometry
            (`GeometryOptions`, without its `seed`).

    Raises:
        OptionError: an option is unknown, out of its range, or one of those.
        DeepDetectError: no homography between the images can be trusted.

    Example:
        >>> from deepdetect.evaluation.controls import RandomPoints
        >>> rng = np.random.default_rng(0)
        >>> scene = cv2.GaussianBlur(rng.integers(0, 256, (160, 200)).astype(np.uint8), (0, 0), 2)
        >>> scene = cv2.normalize(scene, None, 0, 255, cv2.NORM_MINMAX)
        >>> found = register(scene[:, :180], scene[:, 12:], RandomPoints())
        >>> found.homography[:2, 2].round(1).tolist()
        [-12.0, 0.0]
    """
    for name in changes:
        if name in FIXED:
            raise OptionError(
                f"a registration is by a homography and does not take the option {name}: leave it "
                "out, or call match_images"
            )
    first, second = load_image(image0), load_image(image1)
    found = match_images(
        first, second, detector, **changes, guidance="homography", model="homography"
    )
    if not found.guided or found.model is None:
        raise DeepDetectError(
            "no homography can be trusted between these images: they must overlap, and show a "
            "plane or be taken from one place"
        )
    size = (first.shape[1], first.shape[0])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    warped = cv2.warpPerspective(second, found.model, size, flags=flags)
    whole = np.full(second.shape[:2], 255, np.uint8)
    nearest = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    seen = cv2.warpPerspective(whole, found.model, size, flags=nearest) > 0
    return Registration(
        found.model,
        first,
        warped,
        seen,
        len(found),
        agreement(luma(first), luma(second), found.model),
    )
