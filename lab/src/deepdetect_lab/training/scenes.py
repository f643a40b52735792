"""Synthetic scenes: layers of photographs in two views, with known correspondences.

Both views are warped (zoom, rotation, tilt, perspective), the second one often also by a smooth
relief. Parts of photographs may lie in the foreground, each with a small motion of its own. So the
descriptor and the match filter learn parallax and occlusion without real pairs of photographs.
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
"""Default side of the square views. `PERSPECTIVE` is for views of this side. Chosen by hand."""

MARGIN_PX = 6
"""Keypoints closer than this to a view's border are not used: too little is seen around them."""

OFFSET_PX = 90.0
"""The centre of the first view is up to 90 pixels from the photograph's centre along each axis. So
every part of a photograph with sides of 480 pixels is seen by some views."""

SCALE = Effect(1, math.log(0.6), math.log(1.5))
"""Range of the first view's log scale (photograph pixels per view pixel). Chosen by hand."""

SCALE_LIMITS = (0.42, 1.8)
"""The scales of both views, in pixels of the photograph per pixel of the view, are brought into
this range if the zoom between the views allows. Views with a smaller scale would be blurred. Views
with a larger scale would mostly show the mirrored borders of the photograph."""

ZOOMS = (Effect(1, -0.2, 0.2), Effect(0.5, -math.log(2.1), math.log(2.1)))
FAR_ZOOM = Effect(0.18, math.log(1.8), math.log(4.2))
"""Ranges of the logarithm of the zoom from the first to the second view. If several of these
effects happen, the last one counts. `FAR_ZOOM` enlarges or reduces, with equal probability. It is
used because a descriptor trained on less zoom was worse on zoomed images. Chosen by hand."""

ROTATED_SHARES, UPRIGHT_DEVIATIONS = (0.3, 0.45), (0.12, 0.15)
"""Index 0 is for the rotation of the first view, index 1 for the rotation between the views.
`ROTATED_SHARES` are the shares of rotations by any angle. All other angles are small, with the
standard deviations `UPRIGHT_DEVIATIONS` in radians (about 8 degrees). Chosen by hand."""

NORMAL_TILT, TILT_DEVIATION, LARGEST_TILT = 0.7, 0.35, 2.5
"""The tilt of a view is the ratio of its scales along two axes. In the share `NORMAL_TILT` of the
second views, the logarithm of the tilt is the absolute value of a normal variable with the standard
deviation `TILT_DEVIATION`. In all other second views, it is uniform up to the tilt `LARGEST_TILT`,
at which a plane is seen at 66 degrees. At larger tilts, little of the plane can be described. The
other two values are chosen by hand."""

FIRST_TILT, FRONT_TILT = 0.15, 0.3
"""The tilt of the scene in first views is at most 1 + `FIRST_TILT`, and the tilt of foreground
parts at most 1 + `FRONT_TILT`. A tilt of 1 means no tilt. Chosen by hand."""

PERSPECTIVE, FIRST_PERSPECTIVE = 0.0009, 0.5
"""Standard deviation of both perspective coefficients of a homography, per pixel of a view with
`SIDE_PX` pixels a side. A coefficient of this size changes the scale by 11 % from the middle to a
border. In first views, coefficients are multiplied by `FIRST_PERSPECTIVE`. Chosen by hand."""

SHIFT_DEVIATION = 18.0
"""Standard deviation of the second view's shift, in pixels of the first view. Chosen by hand."""

RELIEF_SHARE, RELIEF_PX = 0.45, (1.5, 5.0)
"""`RELIEF_SHARE` is the share of the second views that have a relief. The standard deviation of its
displacements, in pixels, is drawn from the range `RELIEF_PX`. Chosen by hand."""

SMOOTH_CELLS = (3, 8)
"""Reliefs and the outlines of foreground parts are interpolated from 3 to 7 random values along a
side. With more values, a relief could not be inverted, and foreground parts would be smaller than
the area that describes a keypoint."""

FRONT_SHARE, FRONT_COUNTS, OTHER_PHOTOGRAPH_SHARE = 0.5, (1, 1, 2, 3), 0.8
"""`FRONT_SHARE` of the scenes have foreground parts, whose number is drawn from `FRONT_COUNTS`. The
share `OTHER_PHOTOGRAPH_SHARE` of the parts is from other photographs. Chosen by hand."""

SHAPE_PX, UNCOVERED = 480, (0.6, 0.88)
"""A foreground part has the pixels of a photograph at which a smooth noise image, `SHAPE_PX` pixels
a side, exceeds its q-quantile. q is drawn from the range `UNCOVERED`, so a part covers 12 to 40 %
of the photograph. Chosen by hand."""

FRONT_OFFSET_PX, FRONT_SCALE, FRONT_ANGLE = 60.0, 0.2, 0.3
"""Random pose of a foreground part relative to the scene in the first view: the largest offset per
axis in photograph pixels, and the standard deviations of the log scale and of the angle in radians.
Chosen by hand."""

MOTION_SHIFT, MOTION_SCALE, MOTION_ANGLE, MOTION_TILT = 22.0, 0.12, 0.06, 0.15
"""Standard deviations of a foreground part's own motion between the views, relative to the scene's
motion: shift in pixels of the first view, log scale, angle in radians, log tilt. Chosen by hand."""

ALIASED_SCALE, PIXEL_SIGMA = 1.15, 0.5
"""A photograph that is reduced by a factor above `ALIASED_SCALE` is blurred before it is sampled,
against aliasing. A pixel is treated as a Gaussian with a sigma of `PIXEL_SIGMA` pixels. The blur
widens the Gaussian of a photograph's pixel to that of a view's pixel. Chosen by hand."""

COVERED = 0.5
"""A foreground part counts as visible in a pixel if it covers more than this share of the pixel."""

STEP_PX = 2.0
"""Derivatives of the map between the views are central differences over this step to either side,
in pixels. Much smaller steps would suffer from rounding."""

ATTEMPTS = 200
"""A scene is drawn up to this number of times, until its views share enough keypoints. If they
never do, the photographs have too little detail. Chosen by hand."""

ITERATIONS = 5
"""Number of fixed-point iterations to invert a relief. After five, the error is below 0.01 pixels
at 99 % of the positions, and at most 0.5 pixels elsewhere."""


@dataclass(frozen=True)
class View:
    """The map from a view to a photograph: a displacement by the relief, then a homography.

    `relief` holds the displacement (S, S, 2) of each pixel, in pixels. None: no displacement.
    """

    matrix: np.ndarray
    relief: np.ndarray | None = None
    side_px: int = SIDE_PX

    def to_photograph(self, xy: np.ndarray) -> np.ndarray:
        """Map positions in the view, (N, 2) or (H, W, 2), to positions in the photograph."""
        mapped = transform_points(xy + self._moved(xy), self.matrix)
        return mapped.astype(np.float32).reshape(xy.shape)

    def from_photograph(self, xy: np.ndarray) -> np.ndarray:
        """Map (N, 2) positions in the photograph to the view, iteratively if there is a relief."""
        flat = result = transform_points(xy, np.linalg.inv(self.matrix)).astype(np.float32)
        for _ in range(ITERATIONS if self.relief is not None else 0):
            result = flat - self._moved(result)
        return result

    def render(self, image: np.ndarray, border: int = cv2.BORDER_REFLECT_101) -> np.ndarray:
        """Warp an image into the view; return (S, S) float32."""
        at = self.to_photograph(pixels(self.side_px))
        return cv2.remap(image, at, None, cv2.INTER_LINEAR, borderMode=border).astype(np.float32)

    def _moved(self, xy: np.ndarray) -> np.ndarray:
        if self.relief is None or not len(xy):
            return np.zeros_like(xy)
        at = xy.reshape(len(xy), -1, 2)
        moved = cv2.remap(self.relief, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return moved.reshape(xy.shape)


class Layer(NamedTuple):
    """A layer of a scene: an RGB photograph, its map for each of the two views, and its shape.

    The shape is an opacity mask, (H, W) in [0, 1]. None: the layer covers the whole view.
    """

    photograph: np.ndarray
    views: tuple[View, View]
    shape: np.ndarray | None = None


@dataclass(frozen=True)
class Pose:
    """Pose of a view relative to a photograph.

    `middle` is the point of the photograph in the centre of the view. `scale` is in pixels of the
    photograph per pixel of the view, and `angle` in radians. `tilt` is the ratio of the scales
    along two axes.
    """

    middle: np.ndarray
    scale: float
    angle: float
    tilt: float

    def draw_matrix(
        self, rng: np.random.Generator, side_px: int, perspective: float = 1
    ) -> np.ndarray:
        """Draw the homography from view to photograph with a random perspective and tilt axis."""
        azimuth, root = rng.uniform(0, math.pi), math.sqrt(self.tilt)
        linear = rotation(self.angle) @ scaled_along(azimuth, root, 1 / root) * self.scale
        bend = perspective * SIDE_PX / side_px * rng.normal(0, PERSPECTIVE, 2)
        return view_homography(side_px, self.middle, linear, bend)


def draw_layers(
    rng: np.random.Generator,
    files: Sequence[Path],
    side_px: int = SIDE_PX,
    shift_px: float = SHIFT_DEVIATION,
) -> tuple[list[Layer], list[float], float]:
    """Draw a scene: its layers from back to front, the scales of the two views, and their rotation.

    The rotation is the absolute angle between the two views, in radians. The middles of the views
    differ by random shifts with a standard deviation of `shift_px`.
    """
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
    moved = middle + rng.normal(0, shift_px, 2) * scales[0]
    relief = _draw_relief(rng, side_px) if happens(rng, RELIEF_SHARE) else None
    second = Pose(moved, scales[1], sum(angles), math.exp(log_tilt))
    views = View(matrix, None, side_px), View(second.draw_matrix(rng, side_px), relief, side_px)
    layers = [Layer(photograph, views)]
    for _ in range(int(rng.choice(FRONT_COUNTS)) if happens(rng, FRONT_SHARE) else 0):
        layers.append(_draw_front(rng, files, layers[0], (first, second)))
    return layers, scales, abs(angles[1])


def draw_until_seen(
    draw: Callable[[], Drawn | None],
    unseen: str = "the images have too little detail for pairs of views",
) -> Drawn:
    """Call `draw` until it does not return None; raise an OptionError after `ATTEMPTS` calls."""
    for _ in range(ATTEMPTS):
        if (drawn := draw()) is not None:
            return drawn
    raise OptionError(f"{unseen}: use other photographs")


def _draw_photograph(rng: np.random.Generator, files: Sequence[Path]) -> np.ndarray:
    return load_image(files[int(rng.integers(len(files)))])


def _draw_scales(rng: np.random.Generator) -> list[float]:
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
    """Draw a relief: the displacement (S, S, 2) of each pixel of a view, all in one direction."""
    azimuth = rng.uniform(0, 2 * math.pi)
    height = smooth_noise(rng, side_px, SMOOTH_CELLS) * rng.uniform(*RELIEF_PX)
    moved = np.stack([height * math.cos(azimuth), height * math.sin(azimuth)], -1)
    return moved.astype(np.float32)


def _draw_front(
    rng: np.random.Generator, files: Sequence[Path], scene: Layer, poses: tuple[Pose, Pose]
) -> Layer:
    """Draw a foreground part of a scene, which moves with the scene and has a small own motion."""
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


def render_layers(layers: Sequence[Layer], side: int, scale: float) -> tuple[np.ndarray, ...]:
    """Render one of the two views; return (S, S) float32 and the number of each pixel's top layer.

    `side` is 0 for the first view, 1 for the second. `scale` is in pixels of the photograph per
    pixel of the view. The view shows the luma, in grey levels.
    """
    size = (layers[0].views[side].side_px,) * 2
    view, top = np.zeros(size, np.float32), np.zeros(size, np.uint8)
    for number, (photograph, views, shape) in enumerate(layers):
        smooth = luma(photograph)
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


def correspond(
    layers: Sequence[Layer], tops: Sequence[np.ndarray], xy: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Map positions (N, 2) float32 in the first view to the second view.

    `tops` holds, for each of the two views, the number of the top layer in each pixel. Returns the
    positions (N, 2) in the second view, the Jacobians (N, 2, 2) of the map, and a mask (N,) of the
    positions that are visible in the second view.
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
