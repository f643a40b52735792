"""Where the images of a panorama lie, on a plane, a cylinder or a sphere, and putting them there.

Size and memory of a canvas are known before anything is drawn. Exposure and seams are found on
small copies; the images are warped one after the other and blended in frequency bands (Burt and
Adelson, "A multiresolution spline with application to image mosaics", 1983).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from ..._shared.errors import OptionError, RegistrationError
from ..._shared.machine import require_memory
from ..._shared.opencv import cv2
from ...geometry.images import downscale
from ...geometry.transforms import scaled_homography, transform_points, translation_matrix
from .bundle_adjustment import Cameras, Matrices, Sizes

Box = tuple[int, int, int, int]
"""Left, top, right and bottom in pixels, right and bottom outside."""

MAX_DEPTH_RATIO = 5.0
"""How many times farther from the camera one corner of an image may lie on a flat canvas than
another: near the horizon an image is stretched without bound."""

MIN_WARP_SCALE = 0.67
"""An image that the canvas shows smaller than this is downscaled first, against aliasing."""

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


@dataclass(frozen=True, eq=False)
class WarpedImage:
    """An image on the canvas, mirrored beyond its borders, whose left and top are the `corner`.

    The image is (h, w, 3) uint8 or uint16; the mask, (h, w) uint8, is 255 inside.
    """

    image: np.ndarray
    mask: np.ndarray
    corner: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Canvas:
    """Where images lie on a canvas: boxes by the number of the image, or ~number of its rest.

    `draw(place, rgb, scale_of_image, scale_of_canvas)` draws one, both made smaller. A `closed`
    canvas shows all around: its right end goes on at its left one.
    """

    boxes: dict[int, Box]
    draw: Callable[[int, np.ndarray, float, float], WarpedImage]
    closed: bool = False

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        _, _, right, bottom = np.max(list(self.boxes.values()), axis=0).tolist()
        return right, bottom

    def check_size(self, max_megapixels: float) -> None:
        """Raise an OptionError if it has too many pixels, or needs more memory than there is."""
        width, height = self.size
        if width * height > max_megapixels * 1e6:
            raise OptionError(
                f"the panorama would be {width}x{height} pixels, {width * height / 1e6:.0f} "
                f"megapixels and more than max_canvas_megapixels ({max_megapixels:g}): raise it, "
                "or make `scale` smaller"
            )
        require_memory(
            f"a panorama of {width}x{height} pixels would",
            "make `scale` smaller",
            canvas_pixel=width * height,
            blended_pixel=max((box[2] - box[0]) * (box[3] - box[1]) for box in self.boxes.values()),
        )


def least_distorted(sizes: Sizes, homographies: Matrices) -> int:
    """Return the number of the image in whose frame all images are least distorted."""

    def stretch(frame: int) -> float:
        back = np.linalg.inv(homographies[frame])
        depths = [_depths(sizes[number], back @ homographies[number]) for number in homographies]
        least = np.min(depths)
        return round(float(np.max(depths) / least), 1) if least > 0 else np.inf

    return min(homographies, key=stretch)


def plan_plane(
    sizes: Sizes, homographies: Matrices, reference: int, scale: float
) -> tuple[Canvas, dict[int, np.ndarray]]:
    """Find the smallest flat canvas of all images, with so many pixels per pixel of the reference.

    The homographies go to any common frame; those that are returned go to the canvas.
    """
    back = np.linalg.inv(homographies[reference])
    placed = {number: back @ matrix for number, matrix in homographies.items()}
    for number, matrix in placed.items():
        depths = _depths(sizes[number], matrix)
        if depths.min() * MAX_DEPTH_RATIO <= depths.max():
            raise RegistrationError(
                f"images[{number}] is seen too much from the side of images[{reference}] for a "
                "flat panorama: choose a `reference` between them, or, if the camera only turned, "
                "the projection 'cylindrical'"
            )
    placed = {number: scaled_homography(matrix, 1, scale) for number, matrix in placed.items()}
    # A pixel belongs to an image when its centre does.
    edges = {n: transform_points(_edges(sizes[n]), matrix) for n, matrix in placed.items()}
    low = np.ceil(np.min([edge.min(0) for edge in edges.values()], axis=0))
    boxes = {}
    for number, edge in edges.items():
        left, top = (np.ceil(edge.min(0)) - low).astype(int).tolist()
        right, bottom = (np.floor(edge.max(0)) - low).astype(int).tolist()
        boxes[number] = (left, top, right + 1, bottom + 1)
    placed = {number: translation_matrix(*-low) @ matrix for number, matrix in placed.items()}

    def draw(number: int, rgb: np.ndarray, image_scale: float, canvas_scale: float) -> WarpedImage:
        homography, (left, top, right, bottom) = placed[number], boxes[number]
        if (image_scale, canvas_scale) != (1, 1):
            homography = scaled_homography(homography, image_scale, canvas_scale)
            left, top = (int(np.floor(side * canvas_scale)) for side in (left, top))
            right, bottom = (int(np.ceil(side * canvas_scale)) for side in (right, bottom))
        middle = np.array([(rgb.shape[1] - 1) / 2, (rgb.shape[0] - 1) / 2])
        around = transform_points(middle + [[0, 0], [1, 0], [0, 1]], homography)
        shown = float(np.sqrt(abs(np.linalg.det(around[1:] - around[0]))))
        rgb, smaller = _downscaled(rgb, shown)
        if smaller < 1:
            homography = scaled_homography(homography, smaller, 1)
        homography = translation_matrix(-left, -top) @ homography
        size = (right - left, bottom - top)
        drawn = cv2.warpPerspective(
            rgb, homography, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
        )
        whole = np.full(rgb.shape[:2], 255, np.uint8)
        mask = cv2.warpPerspective(whole, homography, size, flags=cv2.INTER_NEAREST)
        return WarpedImage(drawn, mask, (left, top))

    return Canvas(boxes, draw), placed


def plan_curved(
    projection: str, sizes: Sizes, cameras: Cameras, reference: int, scale: float
) -> Canvas:
    """Find the smallest canvas of all images on a cylinder or a sphere.

    It has `scale` pixels per pixel in the middle of the reference, but for a turn of whole pixels.
    Where images show all around, it is cut through the middle of the one that is most behind.
    """
    turn = round(2 * np.pi * cameras[reference].focal_px * scale)
    angles = {n: float(np.arctan2(*one.rotation[[0, 2], 2])) for n, one in cameras.items()}

    def warp(number: int, start: float, canvas_scale: float) -> tuple[Any, Any, int]:
        """Return a warper, its arguments, and the column that is 0 for it.

        It draws each image ahead, where it is in one piece.
        """
        radius = turn * canvas_scale / (2 * np.pi)
        middle = round((angles[number] - start) % (2 * np.pi) * radius)
        ahead = cv2.Rodrigues(np.array([0, -middle / radius - start, 0]))[0]
        matrices = cameras[number].intrinsics(sizes[number]), ahead @ cameras[number].rotation
        arguments = sizes[number], *(matrix.astype(np.float32) for matrix in matrices)
        return cv2.PyRotationWarper(projection, radius), arguments, middle

    def find_boxes(start: float) -> dict[int, Box]:
        boxes = {}
        for number in cameras:
            warper, arguments, middle = warp(number, start, 1)
            left, top, width, height = warper.warpRoi(*arguments)
            boxes[number] = (left + middle, top, left + middle + width, top + height)
        return boxes

    columns = [np.arange(left, right) % turn for left, _, right, _ in find_boxes(0.0).values()]
    closed = len(np.unique(np.concatenate(columns))) == turn
    if closed:
        start = min(angles.values(), key=lambda angle: np.cos(angle - angles[reference]))
    else:  # in the widest gap
        order = np.sort([*angles.values()])
        gaps = np.diff(np.append(order, order[0] + 2 * np.pi))
        start = float((order + gaps / 2)[gaps.argmax()])
    boxes = find_boxes(start)
    top = min(box[1] for box in boxes.values())
    origin = 0 if closed else min(box[0] for box in boxes.values())
    if closed:  # what reaches over an end goes on at the other
        wrapped = {}
        for number, (left, up, right, down) in boxes.items():
            wrapped[number] = (max(left, 0), up, min(right, turn), down)
            if left < 0 or right > turn:
                left, right = (side + (turn if left < 0 else -turn) for side in (left, right))
                wrapped[~number] = (max(left, 0), up, min(right, turn), down)
        boxes = wrapped
    boxes = {n: (b[0] - origin, b[1] - top, b[2] - origin, b[3] - top) for n, b in boxes.items()}

    def draw(place: int, rgb: np.ndarray, image_scale: float, canvas_scale: float) -> WarpedImage:
        number = image_of(place)
        warper, arguments, middle = warp(number, start, canvas_scale)
        (left, up, _, _), *maps = warper.buildMaps(*arguments)
        left += middle
        if closed:
            around = round(turn * canvas_scale)
            left += 0 if place == number else around if left < 0 else -around
            first, last = max(-left, 0), min(around - left, maps[0].shape[1])
            maps = [np.ascontiguousarray(one[:, first:last]) for one in maps]
            left += first
        size = sizes[number]
        inside = [(one > -0.5) & (one < side - 0.5) for one, side in zip(maps, size, strict=True)]
        radius = turn * canvas_scale / (2 * np.pi)
        rgb, smaller = _downscaled(rgb, radius / (cameras[number].focal_px * image_scale))
        for one in maps:  # to pixels of the image that is drawn
            one += np.float32(0.5)
            one *= np.float32(image_scale * smaller)
            one -= np.float32(0.5)
        drawn = cv2.remap(rgb, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        mask = np.logical_and(*inside).astype(np.uint8) * np.uint8(255)
        corner = left - round(origin * canvas_scale), up - round(top * canvas_scale)
        return WarpedImage(drawn, mask, corner)

    return Canvas(boxes, draw, closed)


def image_of(place: int) -> int:
    """Return the number of the image in a place: ~number is where its rest goes on."""
    return max(place, ~place)


def _downscaled(rgb: np.ndarray, shown: float) -> tuple[np.ndarray, float]:
    """Make an image smaller that is shown much smaller; return its scale, too."""
    if shown >= MIN_WARP_SCALE:
        return rgb, 1.0
    return downscale(rgb, max(16, int(np.ceil(shown * max(rgb.shape[:2])))))


def _edges(size: tuple[int, int]) -> np.ndarray:
    """Return the outer corners of an image, half a pixel beyond the outermost centres; (4, 2)."""
    right, bottom = size[0] - 0.5, size[1] - 0.5
    return np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]])


def _depths(size: tuple[int, int], homography: np.ndarray) -> np.ndarray:
    """Return how far before the camera of the frame the corners of an image lie, (4,).

    For images of equal cameras that only turned it is the cosine of the angle off the axis, but for
    a factor; below 0 is behind the horizon.
    """
    # Matrices are known but for a factor; rotations do not mirror.
    matrix = homography / np.cbrt(np.linalg.det(homography))
    return _edges(size) @ matrix[2, :2] + matrix[2, 2]


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
    gains = _gains(low)
    seams = _seams(low, gains)
    parallax = {pair: px / scale for pair, px in _parallax(low, gains, seams).items()}
    blender = _Blender(width, height)
    kind: type = np.uint8
    for place, box in canvas.boxes.items():
        number = image_of(place)
        drawn = canvas.draw(place, load(number), 1.0, 1.0)
        mask = drawn.mask & _upscale_mask(seams[place], low[place].corner, scale, box)
        kind = np.uint16 if drawn.image.dtype == np.uint16 else kind
        top = np.iinfo(drawn.image.dtype).max
        blender.feed(drawn.image, gains[number] / top, mask, box[:2])
    del drawn, mask
    blended, valid = blender.blend()
    panorama: np.ndarray = np.empty(blended.shape, kind)
    for row, values in zip(panorama, blended, strict=True):  # of all at once the copies are large
        row[:] = np.rint(values.clip(0, 1) * np.iinfo(kind).max)
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
        self.valid = np.zeros((height, width), bool)

    def feed(
        self, image: np.ndarray, factor: float, mask: np.ndarray, corner: tuple[int, int]
    ) -> None:
        """Add an image, times a factor, where its mask is 255."""
        (height, width), (x, y), step = mask.shape, corner, 1 << NUM_BANDS
        self.valid[y : y + height, x : x + width] |= mask > 0
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

    def blend(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the (H, W, 3) float32 image, and where there is one; the sums are used up."""
        image: np.ndarray | None = None
        while self.sums:
            band, weight = self.sums.pop(), self.weights.pop()
            band /= np.maximum(weight, np.float32(1e-5))[..., None]
            if image is not None:
                band += cv2.pyrUp(image, dstsize=band.shape[1::-1])
            image = band
        assert image is not None
        height, width = self.valid.shape
        return image[:height, :width], self.valid


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
        seam = np.uint8(255)
        grays = []
        for place, part in zip(places, parts, strict=True):
            if not low[place].mask[part].size:
                break
            seam = seam & cv2.dilate(seams[place][part], np.ones((5, 5), np.uint8))
            seam = seam & cv2.erode(low[place].mask[part], np.ones((9, 9), np.uint8))
            gray = cv2.cvtColor(low[place].image[part], cv2.COLOR_RGB2GRAY)
            grays.append(cv2.convertScaleAbs(gray, alpha=gains[image_of(place)]))
        if len(grays) < 2 or min(grays[0].shape) < MIN_FLOW_PX:
            continue
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


def _upscale_mask(seam: np.ndarray, corner: tuple[int, int], scale: float, box: Box) -> np.ndarray:
    """Return a mask of the small canvas in a box of the canvas, with a margin: no gaps."""
    wide = cv2.dilate(seam, np.ones((3, 3), np.uint8))
    left, top, right, bottom = box
    shift = 0.5 * scale - 0.5
    x, y = scale * left + shift - corner[0], scale * top + shift - corner[1]
    large = cv2.warpAffine(
        wide,
        np.array([[scale, 0, x], [0, scale, y]]),
        (right - left, bottom - top),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
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
