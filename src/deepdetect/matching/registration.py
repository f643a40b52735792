"""Register one image to another by a homography."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from .._shared.alpha import opaque_part
from .._shared.errors import OptionError, RegistrationError, check_name
from .._shared.image_array import Channels, from_16_bits, to_8_bits
from .._shared.opencv import cv2
from .._shared.options import suggest_keywords
from .._shared.value_range import ValueRange
from ..detector.detector import AnyDetector
from ..features.selection import SelectionOptions
from ..geometry.images import (
    median_local_zncc,
    warp_bands,
    warp_visible,
)
from ..geometry.transforms import (
    outer_corners,
    transform_points,
    translation_matrix,
)
from ..io.image import Images, load_pixels, luma, one_range
from ..io.image_file import file_name, is_file
from ..io.picture_file import read_metadata
from .guided.judge import contradicts
from .pipeline import match_images

Extent = Literal["reference", "union"]

MAX_UNION = 4
"""The frame of `extent="union"` has at most this many times both images' pixels. Set by hand."""

SQUARES = 8
"""Number of the checkerboard's squares along the shorter side. Chosen by hand."""


@dataclass(frozen=True, eq=False, repr=False)
class Registration:
    """Two images in one frame: the second is warped to the first by a homography.

    Attributes:
        homography: (3, 3) from the first image to the second.
        first: (H, W, 3) uint8 RGB, the first image in the frame, black outside its own area.
        warped: (H, W, 3) RGB, the second image warped into the frame, black where it has no
            content. It is uint16 if the second image has more than 8 bits, otherwise uint8. A
            uint16 image keeps its numbers.
        valid: (H, W) bool, where the warped image has content.
        matches: number of matches found where the homography predicts them.
        zncc: median local ZNCC of both images over their overlap, in [-1, 1].
        origin: (x, y) of the frame's first pixel in the first image; (0, 0) except for "union".
        applied: the images of `apply_to` warped into the frame, (H, W, C) with all their bands and
            in their own type. Where they have no content, they are 0, or their no-data value.
        value_range: the values of black and white in `warped`, if it is uint16.
        left_out: share of the first image that was ignored because it stands still, as captions do.
    """

    homography: np.ndarray
    first: np.ndarray
    warped: np.ndarray
    valid: np.ndarray
    matches: int
    zncc: float
    origin: tuple[int, int] = (0, 0)
    applied: tuple[np.ndarray, ...] = ()
    value_range: ValueRange = (0, 65535)
    left_out: float = 0.0

    def __repr__(self) -> str:
        height, width = self.valid.shape
        overlap = self.valid.mean()
        return (
            f"Registration({width}x{height}, overlap {overlap:.0%}, {self.matches:,} matches, "
            f"zncc={self.zncc:.3f})"
        )

    def checkerboard(self) -> np.ndarray:
        """Return the first and the warped image as a checkerboard, (H, W, 3) uint8.

        Edges continue from square to square if the images are well registered.
        """
        height, width = self.valid.shape
        side = max(1, min(height, width) // SQUARES)
        row, column = np.indices((height, width)) // side
        second = self.valid & ((row + column) % 2 == 1)
        return np.where(second[..., None], to_8_bits(self.warped, self.value_range), self.first)

    def difference(self) -> np.ndarray:
        """Return the absolute difference of both images, (H, W, 3) uint8; 0 outside the overlap."""
        second = to_8_bits(self.warped, self.value_range)
        return np.where(self.valid[..., None], cv2.absdiff(self.first, second), 0)


@suggest_keywords
def register(
    image0: Any,
    image1: Any,
    detector: AnyDetector | None = None,
    *,
    channels: Channels = "rgb",
    selection: SelectionOptions | None = None,
    ignore: np.ndarray | Images | None = None,
    mutual: bool = False,
    extent: Extent = "reference",
    apply_to: Sequence[Any] = (),
    seed: int = 0,
    progress: Callable[[str], object] | None = None,
) -> Registration:
    """Find the homography between two images and warp the second into the frame of the first.

    This suits planes, and photographs taken from one place. The homography comes from a few
    matches, is refined on the images, and is verified by dense matches.

    Args:
        image0, image1: anything `load_image` takes.
        detector, channels, selection, ignore, progress: see `match_images`.
        mutual: keep only matches that are found in both directions, which takes twice the time.
        extent: "reference" takes the first image as the frame; "union" enlarges the frame to all
            that either image shows.
        apply_to: further images to warp by the same homography, each of the size of the second
            image: images of the same camera, or the file of `image1` itself, to warp all its bands.
        seed: seed of all random choices.

    Raises:
        ImageError: an image cannot be read or is unsuitable.
        OptionError: an option is unknown or out of its range.
        RegistrationError: no homography can be trusted, the images contradict it, or the second
            image is too oblique for a union.

    Example:
        >>> from deepdetect import PointDetector
        >>> rng = np.random.default_rng(0)
        >>> scene = cv2.GaussianBlur(rng.integers(0, 256, (160, 200)).astype(np.uint8), (0, 0), 2)
        >>> scene = cv2.normalize(scene, None, 0, 255, cv2.NORM_MINMAX)
        >>> registration = register(scene[:, :180], scene[:, 12:], PointDetector())
        >>> (registration.homography[:2, 2].round(1) + 0.0).tolist()
        [-12.0, 0.0]
    """
    check_name("extent", extent, get_args(Extent))
    if isinstance(apply_to, str | bytes) or not isinstance(apply_to, Sequence):
        raise OptionError('`apply_to` must be a list of images, such as ["thermal.tif"]')
    with one_range((image1, image0), channels) as reading:
        first, deep = load_pixels(image0, channels), load_pixels(image1, channels, deep=True)
    second = to_8_bits(deep)
    matches = match_images(
        first,
        second,
        detector,
        selection=selection,
        ignore=ignore,
        model="homography",
        mutual=mutual,
        seed=seed,
        progress=progress,
    )
    geometry = matches.geometry
    if geometry is None or geometry.matrix is None:
        raise RegistrationError(
            "no homography can be trusted: both images must show a plane or be taken from one "
            "place, and more than a pattern that repeats"
        )
    homography, left_out = geometry.matrix, geometry.evidence.left_out
    if contradicts(geometry.evidence):
        raise RegistrationError(
            "the images contradict the homography of their matches: warped, they are no more alike "
            "than shifted copies; check that both show one plane or are taken from one place"
        )
    zncc = median_local_zncc(luma(first[:, :, :3]), luma(second[:, :, :3]), homography)
    left, top, right, bottom = 0, 0, first.shape[1], first.shape[0]
    if extent == "union":
        left, top, right, bottom = _union(first.shape, deep.shape, homography)
        margins = (-top, bottom - first.shape[0], -left, right - first.shape[1])
        first = cv2.copyMakeBorder(first, *margins, cv2.BORDER_CONSTANT)
    moved, size = homography @ translation_matrix(left, top), (right - left, bottom - top)
    warped, valid = warp_visible(deep, moved, size)
    (first, empty), hidden = opaque_part(first), opaque_part(deep)[1]
    if empty is not None:  # transparent pixels of the first image show the second
        first = np.where((empty & valid)[..., None], to_8_bits(warped), first)
    values = reading.deep_range or (0, 65535)
    warped = from_16_bits(warped, values) if warped.dtype == np.uint16 else warped
    warped = np.where(valid[..., None], warped, 0)
    applied = []
    for each in apply_to:
        bands = load_pixels(each, channels, deep=True, raw=True)
        if bands.shape[:2] != deep.shape[:2]:
            raise OptionError(
                f"{file_name(each)} must have the size of the second image: leave this image out"
            )
        no_data = read_metadata(each).no_data if is_file(each) else None
        seen = hidden if each is image1 else None
        applied.append(warp_bands(bands, moved, size, no_data, seen))
    numbers = len(matches), zncc, (left, top), tuple(applied), values, left_out
    return Registration(homography, first, warped, valid, *numbers)


def _union(
    shape0: tuple[int, ...], shape1: tuple[int, ...], homography: np.ndarray
) -> tuple[int, int, int, int]:
    """Return left, top, right and bottom of two images' union, in pixels of the first image."""
    height, width = shape1[:2]
    corners = outer_corners((width, height))
    back = np.linalg.inv(homography)
    ends, depths = transform_points(corners, back), corners @ back[2, :2] + back[2, 2]
    # Only pixels whose centre lies inside an image belong to it: edges are rounded inwards.
    low = np.minimum(0, np.ceil(ends.min(axis=0)))
    high = np.maximum([shape0[1], shape0[0]], np.floor(ends.max(axis=0)) + 1)
    pixels = float(np.prod(high - low))
    if depths.min() * depths.max() <= 0 or pixels > MAX_UNION * (
        width * height + np.prod(shape0[:2])
    ):
        raise RegistrationError("the second image is too oblique for a union: leave `extent` out")
    return (*low.astype(int).tolist(), *high.astype(int).tolist())
