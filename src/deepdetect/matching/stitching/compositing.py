"""Composite the images of a panorama on their canvas.

Exposure and seams are found on small copies. Images are warped one by one and blended in frequency
bands (Burt and Adelson, "A multiresolution spline with application to image mosaics", 1983).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import combinations, permutations

import numpy as np

from ..._shared.alpha import continued
from ..._shared.opencv import cv2
from .canvas import Box, Canvas, WarpedImage, image_of

NUM_BANDS = 5
"""Number of frequency bands; the coarsest blends over about 2^5 pixels."""

SEAM_MEGAPIXELS = 0.5
"""Exposure and seams are found on a canvas of at most this many megapixels. Chosen by hand."""

MIN_OVERLAP_PX = 100
"""Two images are compared in brightness and in parallax only if they share at least this many
pixels of the small canvas. Chosen by hand."""

SEAM_TOLERANCE_PX, SEAM_PERCENT = 1.0, 90.0
"""Parallax is reported if the percentile SEAM_PERCENT of the displacements along a seam exceeds
SEAM_TOLERANCE_PX, in pixels of the small canvas. Smaller displacements are invisible."""

MIN_FLOW_PX = 32
"""Optical flow needs an overlap with at least this width and height. Chosen by hand."""

GAIN_ERROR_STD, GAIN_PRIOR_STD = 0.05, 0.5
"""Assumed standard deviations of the log brightness ratio of two images in their overlap, and of
the log gain of an image. Chosen by hand."""


def composite(
    load: Callable[[int], np.ndarray],
    small: Mapping[int, tuple[np.ndarray, float]],
    canvas: Canvas,
    still: np.ndarray = np.array(False),
) -> tuple[np.ndarray, np.ndarray, dict[int, float], dict[tuple[int, int], float]]:
    """Composite images on a canvas.

    `load` returns an image by its number, (H, W, 3) RGB, uint8 or uint16; it is called once per
    box. `small` holds a reduced uint8 copy of each image, and its scale. Pixels that stand still in
    all images (`still`, (h, w) bool) are drawn only where no image shows the scene. Returns the
    panorama, black outside all images and uint16 if any image is; its mask; the gain of each image;
    and, for each pair with visible parallax, its displacement along the seam in panorama pixels.
    """
    width, height = canvas.size
    scale = min(1.0, float(np.sqrt(SEAM_MEGAPIXELS * 1e6 / (width * height))))
    low = {place: canvas.draw(place, *small[image_of(place)], scale) for place in canvas.boxes}
    low = {place: one for place, one in low.items() if one.mask.size}  # omits empty images
    if still.any():
        own = np.dstack([255 * ~still] * 4).astype(np.uint8)
        seen = {
            n: canvas.draw(n, own, small[image_of(n)][1], scale).mask & low[n].mask for n in low
        }
        for place, other in permutations(low, 2):
            here, there = _overlap(low[place], low[other])
            shown = seen[other][there] | low[other].mask[there] * np.uint8(other < place)
            low[place].mask[here][(seen[place][here] == 0) & (shown > 0)] = 0
    gains = _gains(low)
    seams = _seams(low, gains)
    parallax = {pair: px / scale for pair, px in _parallax(low, gains, seams).items()}
    blender = _Blender(width, height)
    kind: type = np.uint8
    for place in low:
        number = image_of(place)
        drawn = canvas.draw(place, load(number), 1.0, 1.0)
        mask = drawn.mask & _upscale_mask(seams[place], drawn.mask.shape)
        image = continued(np.dstack([drawn.image, mask]))[:, :, :3] if still.any() else drawn.image
        kind = np.uint16 if image.dtype == np.uint16 else kind
        blender.feed(image, gains[number] / np.iinfo(image.dtype).max, mask, drawn.corner)
    del drawn, image, mask
    valid = blender.weights[0][:height, :width] > 0
    blended = blender.blend()[:height, :width]
    depth = cv2.CV_16U if kind is np.uint16 else cv2.CV_8U
    panorama = cv2.multiply(blended, (float(np.iinfo(kind).max),) * 4, dtype=depth)
    panorama[~valid] = 0
    return panorama, valid, gains, parallax


class _Blender:
    """Sums, by frequency band, of images weighted by their masks, and sums of the weights."""

    def __init__(self, width: int, height: int) -> None:
        step = 1 << NUM_BANDS
        sides = (-(-height // step) * step, -(-width // step) * step)
        shapes = [(sides[0] >> k, sides[1] >> k) for k in range(NUM_BANDS + 1)]
        self.sums = [np.zeros((*shape, 3), np.float32) for shape in shapes]
        self.weights = [np.zeros(shape, np.float32) for shape in shapes]

    def feed(
        self, image: np.ndarray, factor: float, mask: np.ndarray, corner: tuple[int, int]
    ) -> None:
        """Add an image, multiplied by a factor, where its mask is 255."""
        (height, width), (x, y), step = mask.shape, corner, 1 << NUM_BANDS
        # The box is enlarged to whole pixels of the coarsest band, and by the mask's blur.
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
        """Return the blended float32 image, padded to the coarsest band, and delete the sums."""
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
    """Find gains near 1 that make images equally bright where they overlap.

    The gains solve a least-squares problem as in Brown and Lowe, "Automatic panoramic image
    stitching using invariant features", 2007, but in logarithms.
    """
    numbers = [*dict.fromkeys(map(image_of, low))]
    rows, right = [*np.eye(len(numbers)) / GAIN_PRIOR_STD], [0.0] * len(numbers)
    for (place, first), (other, second) in combinations(low.items(), 2):
        i, j = (numbers.index(image_of(each)) for each in (place, other))
        ratio = None if i == j else _log_ratio(first, second)
        if ratio is not None:
            row = np.zeros(len(numbers))
            row[i], row[j] = 1 / GAIN_ERROR_STD, -1 / GAIN_ERROR_STD
            rows.append(row)
            right.append(ratio / GAIN_ERROR_STD)
    gains = np.exp(np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0])
    return dict(zip(numbers, gains.tolist(), strict=True))


def _log_ratio(first: WarpedImage, second: WarpedImage) -> float | None:
    """Return the log of the second image's brightness over the first's; None for small overlaps."""
    parts = _overlap(first, second)
    shared = (first.mask[parts[0]] > 0) & (second.mask[parts[1]] > 0)
    if np.count_nonzero(shared) < MIN_OVERLAP_PX:
        return None
    both = first.image[parts[0]], second.image[parts[1]]
    means = [float(one[shared].mean()) + 1 for one in both]  # 1 avoids a gain of 0 or infinity
    return float(np.log(means[1] / means[0]))


def _overlap(first: WarpedImage, second: WarpedImage) -> list[tuple[slice, slice]]:
    """Return the slices of the overlap box, rows and columns, in each image; they may be empty."""
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
    """Return the displacement in pixels of each pair with visible parallax along its seam."""
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
    """Find seams where images differ least; return (h, w) uint8 masks on the small canvas."""
    images = [one.image.astype(np.float32) * gains[image_of(n)] for n, one in low.items()]
    corners, masks = [one.corner for one in low.values()], [one.mask for one in low.values()]
    # Dynamic programming is used, because graph cuts take minutes if large overlaps are equal.
    masks = cv2.detail_DpSeamFinder("COLOR").find(images, corners, masks)
    return {n: m.get() if isinstance(m, cv2.UMat) else m for n, m in zip(low, masks, strict=True)}


def _upscale_mask(seam: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Upscale a mask from the small canvas, with a margin so that no gaps remain."""
    wide = cv2.dilate(seam, np.ones((5, 5), np.uint8))
    large = cv2.resize(wide, shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.where(large > 127, np.uint8(255), np.uint8(0))


def crop_box(valid: np.ndarray, whole_rows: bool = False) -> Box:
    """Return the largest rectangle of an (H, W) bool mask that is true everywhere.

    If `whole_rows` and any row is true everywhere, the rectangle has the full width.
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
