"""Composites photographs with known homographies on one flat canvas.

The canvas and its memory are known before anything is drawn. Exposure and seams are found on small
copies; the photographs themselves are warped one after the other, blended in frequency bands
(Burt and Adelson, "A multiresolution spline with application to image mosaics", 1983; OpenCV's).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ..._shared.errors import OptionError, RegistrationError
from ..._shared.memory import require_memory
from ..._shared.opencv import cv2
from ...geometry.rescaling import downscale, scaled_homography
from ...geometry.residuals import transform_points
from .options import DEFAULTS, StitchingOptions

BLEND_FACTOR = 32
"""Brightness is multiplied by this for blending, whose bands are rounded down to whole numbers."""


@dataclass(frozen=True, eq=False)
class Canvas:
    """Where images lie on a canvas.

    Attributes:
        size: (width, height) in pixels.
        homographies: (3, 3) from each image to the canvas, by its number.
        boxes: left, top, right and bottom of each image in pixels, right and bottom outside.
    """

    size: tuple[int, int]
    homographies: dict[int, np.ndarray]
    boxes: dict[int, tuple[int, int, int, int]]


def least_distorted(
    sizes: Mapping[int, tuple[int, int]], homographies: Mapping[int, np.ndarray]
) -> int:
    """Return the number of the image in whose frame all images are least distorted."""

    def stretch(frame: int) -> float:
        back = np.linalg.inv(homographies[frame])
        depths = [_depths(sizes[number], back @ homographies[number]) for number in homographies]
        least = np.min(depths)
        return round(float(np.max(depths) / least), 1) if least > 0 else np.inf

    return min(homographies, key=stretch)


def plan_canvas(
    sizes: Mapping[int, tuple[int, int]],
    homographies: Mapping[int, np.ndarray],
    reference: int,
    *,
    scale: float,
    max_canvas_megapixels: float,
    max_depth_ratio: float = DEFAULTS.max_depth_ratio,
) -> Canvas:
    """Find the smallest canvas that shows all of some images.

    Args:
        sizes: (width, height) of the images, by number.
        homographies: (3, 3) from each to a common frame.
        reference: number of the image that is not distorted.
        scale: pixels of the canvas per pixel of the reference.
        max_canvas_megapixels: the largest canvas allowed.
        max_depth_ratio: see `StitchingOptions`; near the horizon an image is stretched without
            bound.

    Raises:
        RegistrationError: an image reaches the horizon of the reference.
        OptionError: the canvas would have too many pixels, or need more memory than there is.
    """
    back = np.linalg.inv(homographies[reference])
    placed = {number: back @ matrix for number, matrix in homographies.items()}
    for number, matrix in placed.items():
        depths = _depths(sizes[number], matrix)
        if depths.min() * max_depth_ratio <= depths.max():
            raise RegistrationError(
                f"images[{number}] is seen too much from the side of images[{reference}] for a "
                "flat panorama: leave it out, or choose a `reference` between them"
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
    width, height = (max(box[side] for box in boxes.values()) for side in (2, 3))
    shift = np.array([[1, 0, -low[0]], [0, 1, -low[1]], [0, 0, 1]])
    canvas = Canvas((width, height), {n: shift @ matrix for n, matrix in placed.items()}, boxes)
    if width * height > max_canvas_megapixels * 1e6:
        raise OptionError(
            f"the panorama would be {width}x{height} pixels, {width * height / 1e6:.0f} megapixels "
            f"and more than max_canvas_megapixels ({max_canvas_megapixels:g}): raise it, or make "
            "`scale` smaller"
        )
    require_memory(
        f"a panorama of {width}x{height} pixels would",
        "make `scale` smaller",
        canvas_pixel=width * height,
        blended_pixel=max((box[2] - box[0]) * (box[3] - box[1]) for box in boxes.values()),
    )
    return canvas


def _edges(size: tuple[int, int]) -> np.ndarray:
    """Return the outer corners of an image, half a pixel beyond the outermost centres; (4, 2)."""
    right, bottom = size[0] - 0.5, size[1] - 0.5
    return np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]])


def _depths(size: tuple[int, int], homography: np.ndarray) -> np.ndarray:
    """Return how far before the camera of the frame the corners of an image lie, (4,).

    For photographs of equal cameras that only turned it is the cosine of the angle off the axis,
    but for a factor; below 0 is behind the horizon.
    """
    # Matrices are known but for a factor; rotations do not mirror.
    matrix = homography / np.cbrt(np.linalg.det(homography))
    return _edges(size) @ matrix[2, :2] + matrix[2, 2]


def composite(
    load: Callable[[int], np.ndarray],
    small: Mapping[int, tuple[np.ndarray, float]],
    canvas: Canvas,
    options: StitchingOptions = DEFAULTS,
) -> tuple[np.ndarray, np.ndarray, dict[int, float]]:
    """Put images onto a canvas.

    Args:
        load: returns an image, (H, W, 3) uint8 RGB, by its number; it is called once for each.
        small: the same images made smaller, and their scales (`downscale`).
        canvas: where they lie.
        options: of panoramas.

    Returns:
        (H, W, 3) uint8 RGB, black where there is nothing; (H, W) bool where there is something;
        and the factor that the brightness of each image is multiplied by.
    """
    scale, low = _downscaled_canvas(small, canvas, options)
    gains = _gains(low, options)
    seams = _seams(low, gains)
    width, height = canvas.size
    blender = cv2.detail_MultiBandBlender(0, options.num_bands)
    blender.prepare((0, 0, width, height))
    for number, box in canvas.boxes.items():
        homography = canvas.homographies[number]
        drawn, mask = warp_to_box(load(number), homography, box, options.min_warp_scale)
        mask &= _upscale_mask(seams[number], low[number].corner, scale, box)
        bright = cv2.multiply(drawn, (BLEND_FACTOR * gains[number],) * 4, dtype=cv2.CV_16S)
        blender.feed(bright, mask, box[:2])
    del drawn, mask, bright
    blended, valid = blender.blend(None, None)
    panorama = cv2.convertScaleAbs(np.maximum(blended, 0, out=blended), alpha=1 / BLEND_FACTOR)
    panorama[valid == 0] = 0
    return panorama, valid > 0, gains


def warp_to_box(
    rgb: np.ndarray,
    homography: np.ndarray,
    box: tuple[int, int, int, int],
    min_scale: float = DEFAULTS.min_warp_scale,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw an image on its part of the canvas.

    Returns:
        (h, w, 3) uint8, mirrored beyond its borders, and (h, w) uint8 mask, 255 inside.
    """
    left, top, right, bottom = box
    middle = np.array([(rgb.shape[1] - 1) / 2, (rgb.shape[0] - 1) / 2])
    around = transform_points(middle + [[0, 0], [1, 0], [0, 1]], homography)
    shown = float(np.sqrt(abs(np.linalg.det(around[1:] - around[0]))))
    if shown < min_scale:
        rgb, scale = downscale(rgb, max(16, int(np.ceil(shown * max(rgb.shape[:2])))))
        homography = scaled_homography(homography, scale, 1)
    shift = np.array([[1, 0, -left], [0, 1, -top], [0, 0, 1]])
    size = (right - left, bottom - top)
    drawn = cv2.warpPerspective(
        rgb, shift @ homography, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )
    whole = np.full(rgb.shape[:2], 255, np.uint8)
    return drawn, cv2.warpPerspective(whole, shift @ homography, size, flags=cv2.INTER_NEAREST)


@dataclass(frozen=True, eq=False)
class _WarpedImage:
    picture: np.ndarray
    mask: np.ndarray
    corner: tuple[int, int]

    def cut(self, left: int, top: int, right: int, bottom: int) -> tuple[np.ndarray, np.ndarray]:
        x, y = self.corner
        part = (slice(top - y, bottom - y), slice(left - x, right - x))
        return self.picture[part], self.mask[part]


def _downscaled_canvas(
    small: Mapping[int, tuple[np.ndarray, float]], canvas: Canvas, options: StitchingOptions
) -> tuple[float, dict[int, _WarpedImage]]:
    """Draw the small images on a small canvas; return its scale, too."""
    width, height = canvas.size
    scale = min(1.0, float(np.sqrt(options.seam_megapixels * 1e6 / (width * height))))
    low = {}
    for number, (left, top, right, bottom) in canvas.boxes.items():
        picture, shrinking = small[number]
        box = (
            int(np.floor(left * scale)),
            int(np.floor(top * scale)),
            int(np.ceil(right * scale)),
            int(np.ceil(bottom * scale)),
        )
        homography = scaled_homography(canvas.homographies[number], shrinking, scale)
        drawn, mask = warp_to_box(picture, homography, box, options.min_warp_scale)
        low[number] = _WarpedImage(drawn, mask, box[:2])
    return scale, low


def _gains(low: Mapping[int, _WarpedImage], options: StitchingOptions) -> dict[int, float]:
    """Find factors that make images equally bright where they overlap, on the whole near 1.

    Least squares of logarithms, else as Brown and Lowe, "Automatic panoramic image stitching using
    invariant features", 2007.
    """
    numbers = list(low)
    rows, right = [*np.eye(len(low)) / options.gain_prior_std], [0.0] * len(low)
    for i, j in combinations(range(len(low)), 2):
        means = _overlap_means(low[numbers[i]], low[numbers[j]], options.min_overlap_px)
        if means is not None:
            row = np.zeros(len(low))
            row[i], row[j] = 1 / options.gain_error_std, -1 / options.gain_error_std
            rows.append(row)
            right.append(np.log(means[1] / means[0]) / options.gain_error_std)
    gains = np.exp(np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0])
    return dict(zip(numbers, gains.tolist(), strict=True))


def _overlap_means(
    first: _WarpedImage, second: _WarpedImage, min_overlap_px: int
) -> tuple[float, float] | None:
    """Return the mean brightness of both images where they overlap; None for too small a part."""
    (x0, y0), (x1, y1) = first.corner, second.corner
    left, top = max(x0, x1), max(y0, y1)
    right = min(x0 + first.mask.shape[1], x1 + second.mask.shape[1])
    bottom = min(y0 + first.mask.shape[0], y1 + second.mask.shape[0])
    if left >= right or top >= bottom:
        return None
    parts = [one.cut(left, top, right, bottom) for one in (first, second)]
    both = (parts[0][1] > 0) & (parts[1][1] > 0)
    if np.count_nonzero(both) < min_overlap_px:
        return None
    means = [float(picture[both].mean()) + 1 for picture, _ in parts]  # black is not 0 times white
    return means[0], means[1]


def _seams(low: Mapping[int, _WarpedImage], gains: Mapping[int, float]) -> dict[int, np.ndarray]:
    """Divide the overlaps where the images differ least; (h, w) uint8 masks on the small canvas."""
    pictures = [one.picture.astype(np.float32) * gains[number] for number, one in low.items()]
    # Graph cuts take minutes where large overlaps are equal.
    finder = cv2.detail_DpSeamFinder("COLOR")
    masks = finder.find(
        pictures, [one.corner for one in low.values()], [one.mask for one in low.values()]
    )
    return {
        number: mask.get() if isinstance(mask, cv2.UMat) else mask
        for number, mask in zip(low, masks, strict=True)
    }


def _upscale_mask(
    seam: np.ndarray, corner: tuple[int, int], scale: float, box: tuple[int, int, int, int]
) -> np.ndarray:
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
