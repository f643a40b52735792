"""Place the images of a panorama on a plane, a cylinder or a sphere."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..._shared.errors import OptionError, RegistrationError
from ..._shared.machine import require_memory
from ..._shared.opencv import cv2
from ...geometry.camera import Camera
from ...geometry.images import antialiased, without_touched
from ...geometry.transforms import (
    outer_corners,
    scaled_homography,
    scaling_matrix,
    transform_points,
    translation_matrix,
)
from .bundle_adjustment import Cameras, Matrices, Sizes

Box = tuple[int, int, int, int]
"""Left, top, right and bottom in pixels; right and bottom are exclusive."""

MAX_DEPTH_RATIO = 5.0
"""The depths of an image's corners on a flat canvas must differ by less than this factor, because
images near the horizon are stretched without bound. Chosen by hand; not measured."""

MIN_WARP_SCALE, MIN_SHOWN_PX = 0.67, 16
"""An image drawn at a scale below MIN_WARP_SCALE is blurred first, against aliasing. The blur is at
most that for a longer side of MIN_SHOWN_PX on the canvas, because wider blurs take minutes."""


@dataclass(frozen=True, eq=False)
class WarpedImage:
    """An image warped to the canvas, with its top left pixel at `corner`, (x, y).

    `image` is (h, w, 3) uint8 or uint16, and mirrored beyond the borders of the original image.
    `mask`, (h, w) uint8, is 255 inside these borders and 0 beyond them.
    """

    image: np.ndarray
    mask: np.ndarray
    corner: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Canvas:
    """The boxes that images cover on a canvas, and the function that draws them there.

    The keys of `boxes` are image numbers. The right border of a `closed` canvas, of 360 degrees,
    continues at the left. If it splits an image, the rest has a second box, with the key ~number.
    `draw(place, rgb, scale_of_image, scale_of_canvas)` warps an image for the box with the key
    `place`. The scales are those of reduced copies, 1 at full size.
    """

    boxes: dict[int, Box]
    draw: Callable[[int, np.ndarray, float, float], WarpedImage]
    closed: bool = False

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the canvas in pixels."""
        _, _, right, bottom = np.max(list(self.boxes.values()), axis=0).tolist()
        return right, bottom

    def check_size(self, max_megapixels: float) -> None:
        """Raise an OptionError if the canvas has no pixel, or is too large."""
        width, height = self.size
        if not (width and height):
            raise OptionError("at this `scale` the panorama has no pixel: make it larger")
        if width * height > max_megapixels * 1e6:
            raise OptionError(
                f"the panorama would be {width}x{height} pixels, {width * height / 1e6:.0f} "
                f"megapixels and more than max_canvas_megapixels ({max_megapixels:g}): raise this "
                "limit, or make `scale` smaller"
            )
        require_memory(
            f"a panorama of {width}x{height} pixels would",
            "make `scale` smaller",
            canvas_pixel=width * height,
            blended_pixel=max((box[2] - box[0]) * (box[3] - box[1]) for box in self.boxes.values()),
        )


def least_distorted(sizes: Sizes, homographies: Matrices) -> int:
    """Return the number of the image in whose frame the images are least distorted."""

    def stretch(frame: int) -> float:
        back = np.linalg.inv(homographies[frame])
        depths = [_depths(sizes[number], back @ homographies[number]) for number in homographies]
        least = np.min(depths)
        return round(float(np.max(depths) / least), 1) if least > 0 else np.inf

    return min(homographies, key=stretch)


def plan_plane(
    sizes: Sizes, homographies: Matrices, reference: int, scale: float, names: Sequence[str]
) -> tuple[Canvas, dict[int, np.ndarray]]:
    """Find the smallest flat canvas that holds all images, and their homographies to it.

    The canvas has `scale` pixels per pixel of the reference. `homographies` map to a common frame.
    """
    back = np.linalg.inv(homographies[reference])
    placed = {number: back @ matrix for number, matrix in homographies.items()}
    for number, matrix in placed.items():
        depths = _depths(sizes[number], matrix)
        if depths.min() * MAX_DEPTH_RATIO <= depths.max():
            raise RegistrationError(
                f"{names[number]} is too oblique to {names[reference]} for a flat panorama: "
                "choose a `reference` between them, or, if the camera only rotated, the "
                "projection 'cylindrical'"
            )
    placed = {number: scaled_homography(matrix, 1, scale) for number, matrix in placed.items()}
    # Only pixels whose centre lies inside an image belong to it: edges are rounded inwards.
    edges = {n: transform_points(outer_corners(sizes[n]), matrix) for n, matrix in placed.items()}
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
        homography = translation_matrix(-left, -top) @ homography
        size = (right - left, bottom - top)
        smooth = _smooth(rgb, shown)
        drawn = cv2.warpPerspective(
            smooth, homography, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
        )
        whole = np.full(rgb.shape[:2], 255, np.uint8)
        mask = cv2.warpPerspective(whole, homography, size, flags=cv2.INTER_NEAREST)
        return WarpedImage(*without_touched(drawn, mask), (left, top))

    return Canvas(boxes, draw), placed


def plan_curved(
    projection: str, sizes: Sizes, cameras: Cameras, reference: int, scale: float
) -> Canvas:
    """Find the smallest canvas of all images on a cylinder or a sphere.

    It has `scale` pixels per pixel at the centre of the reference, and a full turn is rounded to
    whole pixels. If images show 360 degrees, its borders cut the image opposite the reference.
    """
    turn = round(2 * np.pi * cameras[reference].focal_px * scale)
    angles = {n: float(np.arctan2(*one.rotation[[0, 2], 2])) for n, one in cameras.items()}

    def aimed(number: int, start: float, canvas_scale: float, image_scale: float) -> Any:
        """Return a warper, camera matrices, and the canvas column of the image's middle."""
        radius = turn * canvas_scale / (2 * np.pi)
        middle = round((angles[number] - start) % (2 * np.pi) * radius)
        ahead = cv2.Rodrigues(np.array([0, -middle / radius - start, 0]))[0]
        camera = cameras[number]
        matrix = scaling_matrix(image_scale) @ Camera(sizes[number], camera.focal_px).matrix
        matrices = [one.astype(np.float32) for one in (matrix, ahead @ camera.rotation)]
        return cv2.PyRotationWarper(projection, radius), matrices, middle

    def find_boxes(start: float) -> dict[int, Box]:
        boxes = {}
        for number in cameras:
            warper, camera, middle = aimed(number, start, 1, 1)
            left, top, width, height = warper.warpRoi(sizes[number], *camera)
            boxes[number] = (left + middle, top, left + middle + width, top + height)
        return boxes

    columns = [np.arange(left, right) % turn for left, _, right, _ in find_boxes(0.0).values()]
    closed = len(np.unique(np.concatenate(columns))) == turn
    if closed:
        start = min(angles.values(), key=lambda angle: np.cos(angle - angles[reference]))
    else:  # the canvas is cut in the widest gap
        order = np.sort([*angles.values()])
        gaps = np.diff(np.append(order, order[0] + 2 * np.pi))
        start = float((order + gaps / 2)[gaps.argmax()])
    boxes = find_boxes(start)
    top = min(box[1] for box in boxes.values())
    origin = 0 if closed else min(box[0] for box in boxes.values())
    if closed:  # an image cut by one border continues at the other
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
        shown = turn * canvas_scale / (2 * np.pi * cameras[number].focal_px * image_scale)
        smooth = _smooth(rgb, shown)
        warper, camera, middle = aimed(number, start, canvas_scale, image_scale)
        (left, up, _, _), *maps = warper.buildMaps(rgb.shape[1::-1], *camera)
        drawn = cv2.remap(smooth, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        mask = cv2.remap(np.full(rgb.shape[:2], 255, np.uint8), *maps, cv2.INTER_NEAREST)
        left += middle
        if closed:
            around = round(turn * canvas_scale)
            left += 0 if place == number else around if left < 0 else -around
            part = slice(max(-left, 0), min(around - left, mask.shape[1]))
            drawn, mask, left = drawn[:, part], mask[:, part], left + part.start
        corner = left - round(origin * canvas_scale), up - round(top * canvas_scale)
        return WarpedImage(*without_touched(drawn, mask), corner)

    return Canvas(boxes, draw, closed)


def image_of(place: int) -> int:
    """Return the image number of a key of `Canvas.boxes`, which is the number or ~number."""
    return max(place, ~place)


def _smooth(rgb: np.ndarray, shown: float) -> np.ndarray:
    """Blur an image against aliasing if the scale at which it is drawn, `shown`, is small."""
    if shown >= MIN_WARP_SCALE:
        return rgb
    return antialiased(rgb, max(shown, MIN_SHOWN_PX / max(rgb.shape)))


def _depths(size: tuple[int, int], homography: np.ndarray) -> np.ndarray:
    """Return the depths of an image's corners, (4,), as seen by the camera of the common frame.

    For equal cameras that only rotate, the depths are proportional to the cosines of the angles
    from the optical axis of that camera. Depths beyond the horizon are negative.
    """
    # A determinant of 1, as for a rotation, fixes the arbitrary factor and the sign of the depths.
    matrix = homography / np.cbrt(np.linalg.det(homography))
    return outer_corners(size) @ matrix[2, :2] + matrix[2, 2]
