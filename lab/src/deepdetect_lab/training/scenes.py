"""Synthetic scenes: layers of photographs in two views, with known correspondences.

Both views are warped (zoom, rotation, tilt, perspective), the second also by a smooth relief. Parts
of other photographs may be in front, each with a small motion of its own. So networks learn depth
and occlusion without pairs of real photographs. Learned descriptor and match filter are trained on
them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from deepdetect._shared.errors import OptionError
from deepdetect._shared.opencv import cv2
from deepdetect.geometry.transforms import transform_points
from deepdetect.io.image import load_image, luma

from .synthetic import (
    Effect,
    happens,
    pixels,
    rotation,
    scaled_along,
    smooth_noise,
    view_homography,
)

Drawn = TypeVar("Drawn")

SIDE_PX = 256
"""Default side of the square views, for which perspectives are given. Chosen by hand."""

MARGIN_PX = 6
"""Keypoints this near to the border of a view are not used, because their context is cut off."""

OFFSET_PX = 90.0
"""The centre of the first view is up to 90 pixels from that of the photograph along each axis, so
that photographs of 480 pixels are sometimes seen in every part."""

SCALE = Effect(1, math.log(0.6), math.log(1.5))
"""Log scale of the first view, in pixels of the photograph per pixel. Chosen by hand."""

SCALE_LIMITS = (0.42, 1.8)
"""Scales of both views, in pixels of the photograph per pixel, are kept in this range if the zoom
allows: enlarged views would be blurred, reduced ones would mostly show mirrored borders."""

ZOOMS = (Effect(1, -0.2, 0.2), Effect(0.5, -math.log(2.1), math.log(2.1)))
FAR_ZOOM = Effect(0.18, math.log(1.8), math.log(4.2))
"""Log zoom from the first to the second view. The last effect that is drawn counts; the far zoom
goes in or out. An earlier descriptor, trained on less zoom, was worse on zoomed images."""

ROTATED_SHARES, UPRIGHT_DEVIATIONS = (0.3, 0.45), (0.12, 0.15)
"""Shares of first views, and of second relative to first views, that are rotated by any angle. The
others have these standard deviations in radians, about 8 degrees, like hand-held cameras."""

NORMAL_TILT, TILT_DEVIATION, LARGEST_TILT = 0.7, 0.35, 2.5
"""Tilt is the ratio of the scales along two axes. For this share of second views its logarithm is
normal with this deviation; for the others it is even, up to a tilt of 2.5, a plane seen at 66
degrees, beyond which little of it can be described."""

FIRST_TILT, FRONT_TILT = 0.15, 0.3
"""Tilts of first views exceed 1 by at most these values, for the scene and for parts in front."""

PERSPECTIVE, FIRST_PERSPECTIVE = 0.0009, 0.5
"""Standard deviation of both coefficients of the perspective, per pixel of a view of `SIDE_PX`: the
scale changes by 11 % from the middle to a border. First views have half of it."""

SHIFT_DEVIATION = 18.0
"""Standard deviation of the second view's shift, in pixels of the first. Chosen by hand."""

RELIEF_SHARE, RELIEF_PX = 0.45, (1.5, 5.0)
"""Share of second views with a relief, and range of its height's standard deviation in pixels."""

SMOOTH_CELLS = (3, 8)
"""Relief and shapes have 3 to 7 random values along a side: with more, a relief could not be
inverted and shapes would be smaller than what a keypoint is described by."""

FRONT_SHARE, FRONT_COUNTS, OTHER_PHOTOGRAPH_SHARE = 0.5, (1, 1, 2, 3), 0.8
"""Share of the pairs with parts in front; how many, each as likely as another; and the share of the
parts that are of another photograph."""

SHAPE_PX, UNCOVERED = 480, (0.6, 0.88)
"""Parts in front are where smooth noise of 480 pixels a side is above one of these quantiles: they
cover 12 to 40 % of their photograph, in blobs of any shape."""

FRONT_OFFSET_PX, FRONT_SCALE, FRONT_ANGLE = 60.0, 0.2, 0.3
"""How a part in front lies to the scene in the first view: up to this offset in pixels of the
photograph along each axis; standard deviations of the logarithm of its scale and of its angle in
radians."""

MOTION_SHIFT, MOTION_SCALE, MOTION_ANGLE, MOTION_TILT = 22.0, 0.12, 0.06, 0.15
"""How a part in front moves relative to the scene: standard deviations of the shift in pixels of
the view, of the logarithm of the scale, of the angle in radians, of the logarithm of the tilt."""

ALIASED_SCALE, PIXEL_SIGMA = 1.15, 0.5
"""Photographs reduced by more than the first factor are blurred before sampling, as if pixels of
both images were Gaussians with the second number as sigma, in pixels."""

COVERED = 0.5
"""A part in front covers a pixel if its share is at least this."""

STEP_PX = 2.0
"""Derivatives are differences over this step to both sides: more than what is rounded."""

ATTEMPTS = 200
"""Scenes are redrawn this often; photographs that then still share too little have no detail."""

ITERATIONS = 5
"""Fixed-point iterations to invert a relief: after five, the error is below 0.01 pixels at 99 % of
all places and 0.5 pixels at the worst."""


@dataclass(frozen=True)
class View:
    """Map from a view to a photograph: a (S, S, 2) displacement by a relief, then a homography."""

    matrix: np.ndarray
    relief: np.ndarray | None = None
    side_px: int = SIDE_PX

    def to_photograph(self, xy: np.ndarray) -> np.ndarray:
        """Map (N, 2) or (H, W, 2) positions of the view to the photograph."""
        mapped = transform_points(xy + self._moved(xy), self.matrix)
        return mapped.astype(np.float32).reshape(xy.shape)

    def from_photograph(self, xy: np.ndarray) -> np.ndarray:
        """Map (N, 2) positions of the photograph to the view, iteratively if there is a relief."""
        flat = result = transform_points(xy, np.linalg.inv(self.matrix)).astype(np.float32)
        for _ in range(ITERATIONS if self.relief is not None else 0):
            result = flat - self._moved(result)
        return result

    def render(self, image: np.ndarray, border: int = cv2.BORDER_REFLECT_101) -> np.ndarray:
        """Return what the view shows of an image, (S, S) float32."""
        at = self.to_photograph(pixels(self.side_px))
        return cv2.remap(image, at, None, cv2.INTER_LINEAR, borderMode=border).astype(np.float32)

    def _moved(self, xy: np.ndarray) -> np.ndarray:
        if self.relief is None or not len(xy):
            return np.zeros_like(xy)
        at = xy.reshape(len(xy), -1, 2)
        moved = cv2.remap(self.relief, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return moved.reshape(xy.shape)


class Layer(NamedTuple):
    """A photograph, RGB, in both views; (H, W) float32 in [0, 1] where it covers what is behind."""

    photograph: np.ndarray
    views: tuple[View, View]
    shape: np.ndarray | None = None


@dataclass(frozen=True)
class Pose:
    """Pose of a view: its centre in the photograph, scale, angle and tilt."""

    middle: np.ndarray
    scale: float
    angle: float
    tilt: float

    def draw_matrix(
        self, rng: np.random.Generator, side_px: int, perspective: float = 1
    ) -> np.ndarray:
        """Draw the homography from the view, with a direction of the tilt and a perspective."""
        azimuth, root = rng.uniform(0, math.pi), math.sqrt(self.tilt)
        linear = rotation(self.angle) @ scaled_along(azimuth, root, 1 / root) * self.scale
        bend = perspective * SIDE_PX / side_px * rng.normal(0, PERSPECTIVE, 2)
        return view_homography(side_px, self.middle, linear, bend)


def draw_layers(
    rng: np.random.Generator, files: Sequence[Path], side_px: int = SIDE_PX
) -> tuple[list[Layer], list[float], float]:
    """Draw what two views show, from the back: layers, the views' scales, the angle in radians."""
    photograph = _draw_photograph(rng, files)
    middle = np.array(photograph.shape[1::-1]) / 2 + rng.uniform(-OFFSET_PX, OFFSET_PX, 2)
    scales = _draw_scales(rng)
    angles = [
        rng.uniform(-math.pi, math.pi) if happens(rng, share) else rng.normal(0, deviation)
        for share, deviation in zip(ROTATED_SHARES, UPRIGHT_DEVIATIONS, strict=True)
    ]
    normal = happens(rng, NORMAL_TILT)
    log_tilt = (
        abs(rng.normal(0, TILT_DEVIATION)) if normal else rng.uniform(0, math.log(LARGEST_TILT))
    )
    first = Pose(middle, scales[0], angles[0], 1 + FIRST_TILT * rng.random())
    matrix = first.draw_matrix(rng, side_px, FIRST_PERSPECTIVE)
    moved = middle + rng.normal(0, SHIFT_DEVIATION, 2) * scales[0]
    relief = _draw_relief(rng, side_px) if happens(rng, RELIEF_SHARE) else None
    second = Pose(moved, scales[1], sum(angles), math.exp(log_tilt))
    views = View(matrix, None, side_px), View(second.draw_matrix(rng, side_px), relief, side_px)
    layers = [Layer(photograph, views)]
    for _ in range(int(rng.choice(FRONT_COUNTS)) if happens(rng, FRONT_SHARE) else 0):
        layers.append(_draw_front(rng, files, layers[0], (first, second)))
    return layers, scales, abs(angles[1])


def draw_until_seen(draw: Callable[[], Drawn | None]) -> Drawn:
    """Draw until a draw succeeds; raise an OptionError if the photographs show too little."""
    for _ in range(ATTEMPTS):
        if (drawn := draw()) is not None:
            return drawn
    raise OptionError("the images show too little for pairs of views: use photographs with detail")


def _draw_photograph(rng: np.random.Generator, files: Sequence[Path]) -> np.ndarray:
    return load_image(files[int(rng.integers(len(files)))])


def _draw_scales(rng: np.random.Generator) -> list[float]:
    """Draw the scale of each view, in pixels of the photograph per pixel."""
    scale, zoom = math.exp(SCALE.strength(rng)), 1.0
    for effect in ZOOMS:
        if effect.happens(rng):
            zoom = math.exp(effect.strength(rng))
    if FAR_ZOOM.happens(rng):
        zoom = math.exp(FAR_ZOOM.strength(rng) * rng.choice([-1, 1]))
    smallest, largest = SCALE_LIMITS
    factor = min(1, largest / (scale * max(1, zoom)))
    factor = max(factor, smallest / (scale * min(1, zoom)))
    return [scale * factor, scale * factor * zoom]


def _draw_relief(rng: np.random.Generator, side_px: int) -> np.ndarray:
    """Draw the displacement in pixels of each place of a view, all in one direction."""
    azimuth = rng.uniform(0, 2 * math.pi)
    height = smooth_noise(rng, side_px, SMOOTH_CELLS) * rng.uniform(*RELIEF_PX)
    moved = np.stack([height * math.cos(azimuth), height * math.sin(azimuth)], -1)
    return moved.astype(np.float32)


def _draw_front(
    rng: np.random.Generator, files: Sequence[Path], scene: Layer, poses: tuple[Pose, Pose]
) -> Layer:
    """Draw a part in front of a scene; it moves with the scene, plus a small motion of its own."""
    first, second = poses
    side_px = scene.views[0].side_px
    other = happens(rng, OTHER_PHOTOGRAPH_SHARE)
    photograph = _draw_photograph(rng, files) if other else scene.photograph
    noise = smooth_noise(rng, SHAPE_PX, SMOOTH_CELLS)
    shape = (noise > np.quantile(noise, rng.uniform(*UNCOVERED))).astype(np.float32)
    pose = Pose(
        first.middle + rng.uniform(-FRONT_OFFSET_PX, FRONT_OFFSET_PX, 2),
        first.scale * math.exp(rng.normal(0, FRONT_SCALE)),
        first.angle + rng.normal(0, FRONT_ANGLE),
        1 + FRONT_TILT * rng.random(),
    )
    own = pose.draw_matrix(rng, side_px, FIRST_PERSPECTIVE)
    moved = Pose(
        second.middle + rng.normal(0, MOTION_SHIFT, 2) * first.scale,
        second.scale * math.exp(rng.normal(0, MOTION_SCALE)),
        second.angle + rng.normal(0, MOTION_ANGLE),
        second.tilt * math.exp(rng.normal(0, MOTION_TILT)),
    )
    motion = np.linalg.inv(scene.views[0].matrix) @ moved.draw_matrix(rng, side_px)
    return Layer(photograph, (View(own, None, side_px), View(own @ motion, None, side_px)), shape)


def render_layers(
    layers: Sequence[Layer], side: int, scale: float, mixture: np.ndarray | None = None
) -> tuple[np.ndarray, ...]:
    """Return one of the views, (S, S) float32, and the number of the layer in each pixel.

    In luma, or in a (1, 3) mixture of colours.
    """
    size = (layers[0].views[side].side_px,) * 2
    view, top = np.zeros(size, np.float32), np.zeros(size, np.uint8)
    for number, (photograph, views, shape) in enumerate(layers):
        smooth = luma(photograph) if mixture is None else mix_colours(photograph, mixture)
        if scale > ALIASED_SCALE:
            sigma = PIXEL_SIGMA * math.sqrt(scale * scale - 1)
            smooth = cv2.GaussianBlur(smooth, (0, 0), sigma)
        shown = views[side].render(smooth)
        if shape is None:
            view = shown
            continue
        shape = cv2.resize(shape, smooth.shape[::-1])
        cover = views[side].render(shape, cv2.BORDER_CONSTANT)
        view = view * (1 - cover) + shown * cover
        top[cover > COVERED] = number
    return view, top


def mix_colours(photograph: np.ndarray, mixture: np.ndarray) -> np.ndarray:
    """Return (H, W) uint8 of (H, W, 3), lifted as far as colours that count less than 0 need."""
    mixed = cv2.transform(photograph.astype(np.float32), mixture)
    lifted: np.ndarray = np.clip(mixed - 255 * np.minimum(mixture, 0).sum(), 0, 255)
    return lifted.astype(np.uint8)


def correspond(
    layers: Sequence[Layer], tops: Sequence[np.ndarray], xy: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where the second view shows (N, 2) float32 positions of the first one.

    By the layers, and their numbers in the pixels of both views: (N, 2) positions, (N, 2, 2)
    derivatives of these by those given, and (N,) whether they are seen.
    """
    there, jacobians = np.zeros_like(xy), np.zeros((len(xy), 2, 2))
    layer_of, visible = _at(tops[0], xy), np.zeros(len(xy), bool)
    for number, (photograph, (first, second), _) in enumerate(layers):
        rows = np.flatnonzero(layer_of == number)
        places = first.to_photograph(xy[rows])
        there[rows] = second.from_photograph(places)
        last = np.array(photograph.shape[1::-1]) - 1
        visible[rows] = ((places >= 0) & (places < last)).all(1)
        for axis, step in enumerate(STEP_PX * np.eye(2, dtype=np.float32)):
            ends = (first.to_photograph(xy[rows] + sign * step) for sign in (1, -1))
            after, before = map(second.from_photograph, ends)
            jacobians[rows, :, axis] = (after - before) / (2 * STEP_PX)
    inside = ((there > MARGIN_PX) & (there < len(tops[1]) - 1 - MARGIN_PX)).all(1)
    return there, jacobians, visible & inside & (_at(tops[1], there) == layer_of)


def _at(numbers: np.ndarray, xy: np.ndarray) -> np.ndarray:
    column, row = np.clip(np.rint(xy), 0, len(numbers) - 1).astype(int).T
    return numbers[row, column]
