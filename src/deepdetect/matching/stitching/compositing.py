"""Putting the images of a panorama on their canvas.

Exposure and seams are found on small copies; the images are warped one after the other and blended
in frequency bands (Burt and Adelson, "A multiresolution spline with application to image mosaics",
1983).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import combinations

import numpy as np

from ..._shared.opencv import cv2
from .canvas import Box, Canvas, WarpedImage, image_of

NUM_BANDS = 5
"""Frequency bands; the coarsest blends over about 2^5 pixels."""

SEAM_MEGAPIXELS = 0.5
"""Size of the canvas, at the most, on which exposure and seams are found."""

MIN_OVERLAP_PX = 100
"""Pixels there by which two images must overlap for their brightness to be compared."""

SEAM_TOLERANCE_PX, SEAM_PERCENT = 1.0, 90.0
"""Pixels there that images may differ along nearly all of a seam: on a screen it is not seen."""

MIN_FLOW_PX = 32
"""Side of an overlap in which displacements can be found."""

GAIN_ERROR_STD, GAIN_PRIOR_STD = 0.05, 0.5
"""Standard deviations of log brightness: of what an overlap says of two, and of images."""


def composite(
    load: Callable[[int], np.ndarray],
    small: Mapping[int, tuple[np.ndarray, float]],
    canvas: Canvas,
) -> tuple[np.ndarray, np.ndarray, dict[int, float], dict[tuple[int, int], float]]:
    """Put images onto a canvas.

    `load` returns an image, (H, W, 3) RGB, uint8 or uint16, by its number, and is called once for
    each place; `small` are the same images in uint8, made smaller, and their scales. Returns the
    panorama, black where there is nothing, uint16 where an image is; a mask of where there is
    something; the gain of each image; and by how many pixels of the panorama
    two images differ along their seam, of those that differ too much.
    """
    width, height = canvas.size
    scale = min(1.0, float(np.sqrt(SEAM_MEGAPIXELS * 1e6 / (width * height))))
    low = {place: canvas.draw(place, *small[image_of(place)], scale) for place in canvas.boxes}
    low = {place: one for place, one in low.items() if one.mask.size}  # rests are too narrow there
    gains = _gains(low)
    seams = _seams(low, gains)
    parallax = {pair: px / scale for pair, px in _parallax(low, gains, seams).items()}
    blender = _Blender(width, height)
    kind: type = np.uint8
    for place in low:
        number = image_of(place)
        drawn = canvas.draw(place, load(number), 1.0, 1.0)
        mask = drawn.mask & _upscale_mask(seams[place], drawn.mask.shape)
        kind = np.uint16 if drawn.image.dtype == np.uint16 else kind
        top = np.iinfo(drawn.image.dtype).max
        blender.feed(drawn.image, gains[number] / top, mask, drawn.corner)
    del drawn, mask
    valid = blender.weights[0][:height, :width] > 0
    blended = blender.blend()[:height, :width]
    depth = cv2.CV_16U if kind is np.uint16 else cv2.CV_8U
    panorama = cv2.multiply(blended, (float(np.iinfo(kind).max),) * 4, dtype=depth)
    panorama[~valid] = 0
    return panorama, valid, gains, parallax


class _Blender:
    """Sums of images in frequency bands, weighted by their masks, and of these weights."""

    def __init__(self, width: int, height: int) -> None:
        step = 1 << NUM_BANDS
        sides = (-(-height // step) * step, -(-width // step) * step)
        shapes = [(sides[0] >> k, sides[1] >> k) for k in range(NUM_BANDS + 1)]
        self.sums = [np.zeros((*shape, 3), np.float32) for shape in shapes]
        self.weights = [np.zeros(shape, np.float32) for shape in shapes]

    def feed(
        self, image: np.ndarray, factor: float, mask: np.ndarray, corner: tuple[int, int]
    ) -> None:
        """Add an image, times a factor, where its mask is 255."""
        (height, width), (x, y), step = mask.shape, corner, 1 << NUM_BANDS
        # To whole pixels of the coarsest band, and as far as the mask is spread there.
        rows, columns = self.weights[0].shape
        top, left = (max(0, (start // step - 2) * step) for start in (y, x))
        bottom = min(rows, (-(-(y + height) // step) + 2) * step)
        right = min(columns, (-(-(x + width) // step) + 2) * step)
        margins = (y - top, bottom - y - height, x - left, right - x - width)
        band = cv2.copyMakeBorder(image, *margins, cv2.BORDER_REFLECT).astype(np.float32)
        band *= np.float32(factor)
        weight = cv2.copyMakeBorder(mask, *margins, cv2.BORDER_CONSTANT).astype(np.float32)
        weight *= np.float32(1 / 255)
        for k, (sums, weights) in enumerate(zip(self.sums, self.weights, strict=True)):
            coarse = band
            if k < NUM_BANDS:
                coarse = cv2.pyrDown(band)
                band -= cv2.pyrUp(coarse, dstsize=band.shape[1::-1])
            part = slice(top >> k, bottom >> k), slice(left >> k, right >> k)
            band *= weight[..., None]
            sums[part] += band
            weights[part] += weight
            band, weight = coarse, cv2.pyrDown(weight)

    def blend(self) -> np.ndarray:
        """Return a float32 image, of whole pixels of the coarsest band; the sums are used up."""
        image: np.ndarray | None = None
        while self.sums:
            band, weight = self.sums.pop(), self.weights.pop()
            band /= np.maximum(weight, np.float32(1e-5))[..., None]
            if image is not None:
                band += cv2.pyrUp(image, dstsize=band.shape[1::-1])
            image = band
        assert image is not None
        return image


def _gains(low: Mapping[int, WarpedImage]) -> dict[int, float]:
    """Find factors that make images equally bright where they overlap, on the whole near 1.

    Least squares of logarithms, else as Brown and Lowe, "Automatic panoramic image stitching using
    invariant features", 2007.
    """
    numbers = [*dict.fromkeys(map(image_of, low))]
    rows, right = [*np.eye(len(numbers)) / GAIN_PRIOR_STD], [0.0] * len(numbers)
    for (place, first), (other, second) in combinations(low.items(), 2):
        i, j = (numbers.index(image_of(each)) for each in (place, other))
        means = None if i == j else _overlap_means(first, second)
        if means is not None:
            row = np.zeros(len(numbers))
            row[i], row[j] = 1 / GAIN_ERROR_STD, -1 / GAIN_ERROR_STD
            rows.append(row)
            right.append(np.log(means[1] / means[0]) / GAIN_ERROR_STD)
    gains = np.exp(np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0])
    return dict(zip(numbers, gains.tolist(), strict=True))


def _overlap_means(first: WarpedImage, second: WarpedImage) -> tuple[float, float] | None:
    """Return the mean brightness of both images where they overlap; None for too small a part."""
    parts = _overlap(first, second)
    shared = (first.mask[parts[0]] > 0) & (second.mask[parts[1]] > 0)
    if np.count_nonzero(shared) < MIN_OVERLAP_PX:
        return None
    # Black is not 0 times white.
    means = [
        float(one.image[part][shared].mean()) + 1
        for one, part in zip((first, second), parts, strict=True)
    ]
    return means[0], means[1]


def _overlap(first: WarpedImage, second: WarpedImage) -> list[tuple[slice, slice]]:
    """Return the rows and columns of both that are the same box of the canvas; it may be empty."""
    both = first, second
    left, top = np.max([one.corner for one in both], axis=0)
    right, bottom = np.min([np.add(one.corner, one.mask.shape[::-1]) for one in both], axis=0)
    return [
        (slice(top - y, max(top, bottom) - y), slice(left - x, max(left, right) - x))
        for x, y in (first.corner, second.corner)
    ]


def _parallax(
    low: Mapping[int, WarpedImage], gains: Mapping[int, float], seams: Mapping[int, np.ndarray]
) -> dict[tuple[int, int], float]:
    """Find by how many pixels images differ along their seams, of those that differ too much."""
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    found: dict[tuple[int, int], float] = {}
    for places in combinations(low, 2):
        parts = _overlap(*(low[place] for place in places))
        if min(low[places[0]].mask[parts[0]].shape) < MIN_FLOW_PX:
            continue
        seam = np.uint8(255)
        grays = []
        for place, part in zip(places, parts, strict=True):
            seam = seam & cv2.dilate(seams[place][part], np.ones((5, 5), np.uint8))
            seam = seam & cv2.erode(low[place].mask[part], np.ones((9, 9), np.uint8))
            gray = cv2.cvtColor(low[place].image[part], cv2.COLOR_RGB2GRAY)
            grays.append(cv2.convertScaleAbs(gray, alpha=gains[image_of(place)]))
        forward, backward = flow.calc(*grays, None), flow.calc(*grays[::-1], None)
        y, x = np.indices(grays[0].shape, np.float32)
        ends = forward + np.dstack([x, y])
        back = cv2.remap(backward, ends, None, cv2.INTER_LINEAR)
        known = (seam > 0) & (np.linalg.norm(forward + back, axis=2) < SEAM_TOLERANCE_PX)
        if np.count_nonzero(known) < MIN_OVERLAP_PX:
            continue
        distance = float(np.percentile(np.linalg.norm(forward[known], axis=1), SEAM_PERCENT))
        if distance > SEAM_TOLERANCE_PX:
            first, second = sorted(map(image_of, places))
            found[first, second] = max(distance, found.get((first, second), 0.0))
    return found


def _seams(low: Mapping[int, WarpedImage], gains: Mapping[int, float]) -> dict[int, np.ndarray]:
    """Divide the overlaps where the images differ least; (h, w) uint8 masks on the small canvas."""
    images = [one.image.astype(np.float32) * gains[image_of(n)] for n, one in low.items()]
    corners, masks = [one.corner for one in low.values()], [one.mask for one in low.values()]
    # Graph cuts take minutes where large overlaps are equal.
    masks = cv2.detail_DpSeamFinder("COLOR").find(images, corners, masks)
    return {
        number: mask.get() if isinstance(mask, cv2.UMat) else mask
        for number, mask in zip(low, masks, strict=True)
    }


def _upscale_mask(seam: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return a mask of the small canvas in the shape of the large one, with a margin: no gaps."""
    wide = cv2.dilate(seam, np.ones((5, 5), np.uint8))
    large = cv2.resize(wide, shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.where(large > 127, np.uint8(255), np.uint8(0))


def crop_box(valid: np.ndarray, whole_rows: bool = False) -> Box:
    """Return the largest rectangle of a mask, (H, W) bool, that is true everywhere.

    With `whole_rows` it has the full width, if a row has.
    Row by row, for each column: the run that ends there, and how far its height reaches sideways.
    """
    if whole_rows and valid.all(axis=1).any():
        valid = np.repeat(valid.all(axis=1, keepdims=True), valid.shape[1], axis=1)
    width = valid.shape[1]
    column = np.arange(width)
    runs, left, right = np.zeros(width, int), np.zeros(width, int), np.full(width, width)
    area, box = 0, (0, 0, 0, 0)
    for y, row in enumerate(valid):
        gap_before = np.maximum.accumulate(np.where(row, -1, column))
        gap_after = np.minimum.accumulate(np.where(row, width, column)[::-1])[::-1]
        runs = np.where(row, runs + 1, 0)
        left = np.where(row, np.maximum(left, gap_before + 1), 0)
        right = np.where(row, np.minimum(right, gap_after), width)
        areas = runs * (right - left)
        best = int(areas.argmax())
        if areas[best] > area:
            area = int(areas[best])
            box = (int(left[best]), y + 1 - int(runs[best]), int(right[best]), y + 1)
    return box
