"""Composites images on a canvas.

Exposure and seams are found on small copies; the images themselves are warped one after the other,
blended in frequency bands (Burt and Adelson, "A multiresolution spline with application to image
mosaics", 1983; OpenCV's).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import combinations

import numpy as np

from ..._shared.opencv import cv2
from .canvas import Box, Canvas, WarpedImage

BLEND_FACTOR = 32
"""Brightness is multiplied by this for blending, whose bands are rounded down to whole numbers."""

NUM_BANDS = 5
"""Frequency bands; the coarsest blends over about 2^5 pixels."""

SEAM_MEGAPIXELS = 0.5
"""Size of the canvas, at the most, on which exposure and seams are found."""

MIN_OVERLAP_PX = 100
"""Pixels there by which two images must overlap for their brightness to be compared."""

GAIN_ERROR_STD, GAIN_PRIOR_STD = 0.05, 0.5
"""Standard deviations of the logarithm of brightness: of what an overlap says about two images, and
of the images themselves."""


def composite(
    load: Callable[[int], np.ndarray],
    small: Mapping[int, tuple[np.ndarray, float]],
    canvas: Canvas,
) -> tuple[np.ndarray, np.ndarray, dict[int, float]]:
    """Put images onto a canvas.

    Args:
        load: returns an image, (H, W, 3) uint8 RGB, by its number; it is called once for each.
        small: the same images made smaller, and their scales (`downscale`).
        canvas: where they lie.

    Returns:
        (H, W, 3) uint8 RGB, black where there is nothing; (H, W) bool where there is something;
        and the factor that the brightness of each image is multiplied by.
    """
    width, height = canvas.size
    scale = min(1.0, float(np.sqrt(SEAM_MEGAPIXELS * 1e6 / (width * height))))
    low = {number: canvas.draw(number, *small[number], scale) for number in canvas.boxes}
    gains = _gains(low)
    seams = _seams(low, gains)
    blender = cv2.detail_MultiBandBlender(0, NUM_BANDS)
    blender.prepare((0, 0, width, height))
    for number, box in canvas.boxes.items():
        drawn = canvas.draw(number, load(number), 1.0, 1.0)
        mask = drawn.mask & _upscale_mask(seams[number], low[number].corner, scale, box)
        bright = cv2.multiply(drawn.image, (BLEND_FACTOR * gains[number],) * 4, dtype=cv2.CV_16S)
        blender.feed(bright, mask, box[:2])
    del drawn, mask, bright
    blended, valid = blender.blend(None, None)
    panorama = cv2.convertScaleAbs(np.maximum(blended, 0, out=blended), alpha=1 / BLEND_FACTOR)
    panorama[valid == 0] = 0
    return panorama, valid > 0, gains


def _gains(low: Mapping[int, WarpedImage]) -> dict[int, float]:
    """Find factors that make images equally bright where they overlap, on the whole near 1.

    Least squares of logarithms, else as Brown and Lowe, "Automatic panoramic image stitching using
    invariant features", 2007.
    """
    numbers = list(low)
    rows, right = [*np.eye(len(low)) / GAIN_PRIOR_STD], [0.0] * len(low)
    for i, j in combinations(range(len(low)), 2):
        means = _overlap_means(low[numbers[i]], low[numbers[j]])
        if means is not None:
            row = np.zeros(len(low))
            row[i], row[j] = 1 / GAIN_ERROR_STD, -1 / GAIN_ERROR_STD
            rows.append(row)
            right.append(np.log(means[1] / means[0]) / GAIN_ERROR_STD)
    gains = np.exp(np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0])
    return dict(zip(numbers, gains.tolist(), strict=True))


def _overlap_means(first: WarpedImage, second: WarpedImage) -> tuple[float, float] | None:
    """Return the mean brightness of both images where they overlap; None for too small a part."""
    (x0, y0), (x1, y1) = first.corner, second.corner
    left, top = max(x0, x1), max(y0, y1)
    right = min(x0 + first.mask.shape[1], x1 + second.mask.shape[1])
    bottom = min(y0 + first.mask.shape[0], y1 + second.mask.shape[0])
    if left >= right or top >= bottom:
        return None
    parts = [
        (one, (slice(top - y, bottom - y), slice(left - x, right - x)))
        for one, (x, y) in ((first, first.corner), (second, second.corner))
    ]
    both = np.logical_and(*(one.mask[part] > 0 for one, part in parts))
    if np.count_nonzero(both) < MIN_OVERLAP_PX:
        return None
    # Black is not 0 times white.
    means = [float(one.image[part][both].mean()) + 1 for one, part in parts]
    return means[0], means[1]


def _seams(low: Mapping[int, WarpedImage], gains: Mapping[int, float]) -> dict[int, np.ndarray]:
    """Divide the overlaps where the images differ least; (h, w) uint8 masks on the small canvas."""
    images = [one.image.astype(np.float32) * gains[number] for number, one in low.items()]
    # Graph cuts take minutes where large overlaps are equal.
    finder = cv2.detail_DpSeamFinder("COLOR")
    masks = finder.find(
        images, [one.corner for one in low.values()], [one.mask for one in low.values()]
    )
    return {
        number: mask.get() if isinstance(mask, cv2.UMat) else mask
        for number, mask in zip(low, masks, strict=True)
    }


def _upscale_mask(seam: np.ndarray, corner: tuple[int, int], scale: float, box: Box) -> np.ndarray:
    """Return a mask of the small canvas in a box of the canvas, with a margin: no gaps."""
    wide = cv2.dilate(seam, np.ones((3, 3), np.uint8))
    left, top, right, bottom = box
    shift = 0.5 * scale - 0.5
    affine = np.array(
        [
            [scale, 0, scale * left + shift - corner[0]],
            [0, scale, scale * top + shift - corner[1]],
        ]
    )
    large = cv2.warpAffine(
        wide,
        affine,
        (right - left, bottom - top),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.where(large > 127, np.uint8(255), np.uint8(0))


def crop_box(valid: np.ndarray) -> Box:
    """Return the largest rectangle of a mask, (H, W) bool, that is true everywhere.

    Example:
        >>> valid = np.ones((20, 30), bool)
        >>> valid[3, 25] = False
        >>> crop_box(valid)
        (0, 0, 25, 20)
    """
    from .crop_kernel import largest_rectangle

    return largest_rectangle(valid)
