"""Where the images of a panorama lie: on a plane, a cylinder or a sphere.

Size and memory of a canvas are known before anything is drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from ..._shared.errors import OptionError, RegistrationError
from ..._shared.memory import require_memory
from ..._shared.opencv import cv2
from ...geometry.images import downscale
from ...geometry.transforms import scaled_homography, transform_points
from .bundle_adjustment import RotatingCamera

Box = tuple[int, int, int, int]
"""Left, top, right and bottom in pixels, right and bottom outside."""

MAX_DEPTH_RATIO = 5.0
"""How many times farther from the camera one corner of an image may lie on a flat canvas than
another: near the horizon an image is stretched without bound."""

MIN_WARP_SCALE = 0.67
"""An image that the canvas shows smaller than this is downscaled first, against aliasing."""


@dataclass(frozen=True, eq=False)
class WarpedImage:
    """An image on the canvas.

    Attributes:
        image: (h, w, 3) uint8, mirrored beyond its borders.
        mask: (h, w) uint8, 255 inside.
        corner: left and top of them on the canvas.
    """

    image: np.ndarray
    mask: np.ndarray
    corner: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Canvas:
    """Where images lie on a canvas.

    Attributes:
        size: (width, height) in pixels.
        boxes: of each image, by its number.
        draw: draws an image, by its number, on the canvas, both made smaller: `draw(number, rgb,
            scale_of_image, scale_of_canvas)`.
    """

    size: tuple[int, int]
    boxes: dict[int, Box]
    draw: Callable[[int, np.ndarray, float, float], WarpedImage]

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


def plan_plane(
    sizes: Mapping[int, tuple[int, int]],
    homographies: Mapping[int, np.ndarray],
    reference: int,
    scale: float,
) -> tuple[Canvas, dict[int, np.ndarray]]:
    """Find the smallest flat canvas that shows all of some images.

    Args:
        sizes: (width, height) of the images, by number.
        homographies: (3, 3) from each to a common frame.
        reference: number of the image that is not distorted.
        scale: pixels of the canvas per pixel of the reference.

    Returns:
        The canvas, and the homographies from each image to it.

    Raises:
        RegistrationError: an image reaches the horizon of the reference.
    """
    back = np.linalg.inv(homographies[reference])
    placed = {number: back @ matrix for number, matrix in homographies.items()}
    for number, matrix in placed.items():
        depths = _depths(sizes[number], matrix)
        if depths.min() * MAX_DEPTH_RATIO <= depths.max():
            raise RegistrationError(
                f"images[{number}] is seen too much from the side of images[{reference}] for a "
                "flat panorama: choose the projection 'cylindrical', or a `reference` between them"
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
    shift = np.array([[1, 0, -low[0]], [0, 1, -low[1]], [0, 0, 1]])
    placed = {number: shift @ matrix for number, matrix in placed.items()}
    return Canvas(_size(boxes), boxes, partial(draw_plane, placed, boxes)), placed


def draw_plane(
    homographies: Mapping[int, np.ndarray],
    boxes: Mapping[int, Box],
    number: int,
    rgb: np.ndarray,
    image_scale: float,
    canvas_scale: float,
) -> WarpedImage:
    """Draw an image on a flat canvas, as of `Canvas.draw`."""
    homography, (left, top, right, bottom) = homographies[number], boxes[number]
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
    homography = np.array([[1, 0, -left], [0, 1, -top], [0, 0, 1]]) @ homography
    size = (right - left, bottom - top)
    drawn = cv2.warpPerspective(
        rgb, homography, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )
    whole = np.full(rgb.shape[:2], 255, np.uint8)
    mask = cv2.warpPerspective(whole, homography, size, flags=cv2.INTER_NEAREST)
    return WarpedImage(drawn, mask, (left, top))


def plan_curved(
    projection: Literal["cylindrical", "spherical"],
    sizes: Mapping[int, tuple[int, int]],
    cameras: Mapping[int, RotatingCamera],
    reference: int,
    scale: float,
) -> Canvas:
    """Find the smallest canvas on a cylinder or a sphere that shows all of some images.

    Args:
        projection: of the canvas.
        sizes: (width, height) of the images, by number.
        cameras: of the images.
        reference: number of the image that gives the canvas its scale.
        scale: pixels of the canvas per pixel in the middle of the reference.
    """
    radius_px = cameras[reference].focal_px * scale
    warper = cv2.PyRotationWarper(projection, radius_px)
    boxes = {}
    for number, camera in cameras.items():
        size = sizes[number]
        left, top, width, height = warper.warpRoi(size, *_as_float32(camera, size))
        boxes[number] = (left, top, left + width, top + height)
    x, y = (min(box[side] for box in boxes.values()) for side in (0, 1))
    boxes = {n: (box[0] - x, box[1] - y, box[2] - x, box[3] - y) for n, box in boxes.items()}
    draw = partial(draw_curved, projection, radius_px, (x, y), sizes, cameras)
    return Canvas(_size(boxes), boxes, draw)


def draw_curved(
    projection: str,
    radius_px: float,
    origin: tuple[int, int],
    sizes: Mapping[int, tuple[int, int]],
    cameras: Mapping[int, RotatingCamera],
    number: int,
    rgb: np.ndarray,
    image_scale: float,
    canvas_scale: float,
) -> WarpedImage:
    """Draw an image on a curved canvas, as of `Canvas.draw`; `origin` is its left and top."""
    camera, size, radius_px = cameras[number], sizes[number], radius_px * canvas_scale
    warper = cv2.PyRotationWarper(projection, radius_px)
    (left, top, _, _), *maps = warper.buildMaps(size, *_as_float32(camera, size))
    inside = [(one > -0.5) & (one < side - 0.5) for one, side in zip(maps, size, strict=True)]
    rgb, smaller = _downscaled(rgb, radius_px / (camera.focal_px * image_scale))
    for one in maps:  # to pixels of the image that is drawn
        one += np.float32(0.5)
        one *= np.float32(image_scale * smaller)
        one -= np.float32(0.5)
    drawn = cv2.remap(rgb, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    mask = np.logical_and(*inside).astype(np.uint8) * np.uint8(255)
    x, y = (round(side * canvas_scale) for side in origin)
    return WarpedImage(drawn, mask, (left - x, top - y))


def _as_float32(camera: RotatingCamera, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the intrinsics of an image of (width, height), and the rotation, for OpenCV."""
    return camera.intrinsics(size).astype(np.float32), camera.rotation.astype(np.float32)


def _size(boxes: Mapping[int, Box]) -> tuple[int, int]:
    return max(box[2] for box in boxes.values()), max(box[3] for box in boxes.values())


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
