"""Synthetic views, for all trainings: where a view is taken from, its light, blur, noise and JPEG.

What is done to a view stands here once. How often and how strongly is the recipe of a task: `Light`
and `Camera`, of `Effect`s, beside the views of that task.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from deepdetect._shared.opencv import cv2

from ..datasets.degradation import motion_kernel

WHITE = 255
"""The highest grey level of an 8-bit image."""

MIDDLE_GREY = 0.5
"""Contrast is changed around this value of [0, 1], so that the mean brightness stays."""

NOISE_CELLS = (2, 5)
"""Smooth light has 2 to 4 random values along a side: it varies over half the view or more, as
light in a room does."""

LIT_RANGE = (0.15, 1.6)
"""Smooth light multiplies values by no less and no more: darker places would show nothing, brighter
ones only white."""

SHADOW_REACH_PX = 80.0
"""The edge of a shadow passes the middle of the view within 80 pixels, so that both sides are
seen."""

SHADOW_EDGE_PX = (0.7, 8.0)
"""The edge of a shadow is blurred by a sigma of 0.7 pixels (the sun, near) to 8 (a window)."""

CURVE_TONES = 6
"""A curve of tones rises through 6 random values between black and white."""

DARK_NOISE_LEVELS, DARK_NOISE_LIGHT = (0.2, 0.6, 3.0), 0.25
"""Sigma of the noise in little light is at least 0.2 grey levels. Its maximum grows from 0.6
without light to 3.0 at 1/4 of the light, since fewer photons have less shot noise."""


def happens(rng: np.random.Generator, share: float) -> bool:
    """Whether something happens to a view; if to all or to none, nothing is drawn."""
    return share >= 1 or (share > 0 and rng.random() < share)


class Effect(NamedTuple):
    """How often something happens to a view, and how strongly.

    The strength is drawn evenly; a power above 1 makes low ones more frequent, below 1 high ones.
    """

    share: float
    low: float
    high: float
    power: float = 1

    def happens(self, rng: np.random.Generator) -> bool:
        """Whether it happens to a view."""
        return happens(rng, self.share)

    def strength(self, rng: np.random.Generator) -> float:
        """Draw how strongly it happens."""
        return self.low + (self.high - self.low) * float(rng.random()) ** self.power

    def whole(self, rng: np.random.Generator) -> int:
        """Draw a whole number, below the high end."""
        return int(rng.integers(int(self.low), int(self.high)))


NEVER = Effect(0, 0, 0)


@dataclass(frozen=True)
class Light:
    """How `relight` changes values in [0, 1].

    Attributes:
        share: of the views that are changed at all.
        field: smooth light: by which fraction it varies.
        shadow: a shadow with an edge: the fraction of the light that it takes.
        log_gamma: natural logarithm of the exponent.
        curve: share of the views with any rising curve of tones.
        contrast: factor around the middle grey.
        log_gain: natural logarithm of the factor of all values.
        ramp: light that grows along a line: by which fraction from border to border.
        shift: range of what is added with a contrast or a gain.
    """

    share: float = 1
    field: Effect = NEVER
    shadow: Effect = NEVER
    log_gamma: Effect = NEVER
    curve: float = 0
    contrast: Effect = NEVER
    log_gain: Effect = NEVER
    ramp: Effect = NEVER
    shift: tuple[float, float] = (0, 0)


@dataclass(frozen=True)
class Camera:
    """What `blur` and `record` do.

    Attributes:
        blur: sigma of a Gaussian in pixels.
        motion: of the views that are not blurred so: length of a motion in whole pixels.
        log_dark: natural logarithm of the fraction of the light that is left, with noise.
        noise: of the other views: sigma in grey levels, by the first of these that happens.
        jpeg: quality, a whole number.
    """

    blur: Effect = NEVER
    motion: Effect = NEVER
    log_dark: Effect = NEVER
    noise: tuple[Effect, ...] = ()
    jpeg: Effect = NEVER


def relight(rng: np.random.Generator, view: np.ndarray, light: Light) -> np.ndarray:
    """Change the light of (S, S) values in [0, 1]; of any shape without field, shadow and ramp."""
    if not happens(rng, light.share):
        return view
    if light.field.happens(rng):
        field, strength = smooth_noise(rng, len(view), NOISE_CELLS), light.field.strength(rng)
        view = view * np.clip(1 + strength * field / np.abs(field).max(), *LIT_RANGE)
    if light.shadow.happens(rng):
        direction = rotation(rng.uniform(0, 2 * math.pi))[0]
        edge = rng.uniform(-SHADOW_REACH_PX, SHADOW_REACH_PX)
        side = (pixels(len(view)) - len(view) / 2) @ direction > edge
        shadow = cv2.GaussianBlur(side.astype(np.float32), (0, 0), rng.uniform(*SHADOW_EDGE_PX))
        view = view * (1 - shadow * light.shadow.strength(rng))
    if light.log_gamma.happens(rng):
        view = np.clip(view, 0, None) ** math.exp(light.log_gamma.strength(rng))
    if happens(rng, light.curve):
        tones = np.concatenate([[0], np.sort(rng.random(CURVE_TONES)), [1]])
        view = np.interp(view, np.linspace(0, 1, len(tones)), tones).astype(view.dtype)
    if contrasted := light.contrast.happens(rng):
        view = (view - MIDDLE_GREY) * light.contrast.strength(rng) + MIDDLE_GREY
    if gained := light.log_gain.happens(rng):
        view = view * math.exp(light.log_gain.strength(rng))
    if light.ramp.happens(rng):
        direction = rotation(rng.uniform(0, 2 * math.pi))[:, 0].astype(np.float32)
        across = (pixels(len(view)) / len(view) - np.float32(0.5)) @ direction
        view = view * (1 + light.ramp.strength(rng) * across)
    return view + rng.uniform(*light.shift) if contrasted or gained else view


def blur(rng: np.random.Generator, view: np.ndarray, camera: Camera) -> np.ndarray:
    """Blur a view of any type as an unfocused lens or a motion does, if the recipe says so."""
    if camera.blur.happens(rng):
        return cv2.GaussianBlur(view, (0, 0), camera.blur.strength(rng))
    if camera.motion.happens(rng):
        length = camera.motion.whole(rng)
        return cv2.filter2D(view, -1, motion_kernel(length, rng.uniform(0, math.pi)))
    return view


def record(rng: np.random.Generator, levels: np.ndarray, camera: Camera) -> np.ndarray:
    """Make the uint8 image that a camera stores of a view in grey levels, any float type."""
    if camera.log_dark.happens(rng):
        light = math.exp(camera.log_dark.strength(rng))
        least, *most = DARK_NOISE_LEVELS
        sigma = rng.uniform(least, np.interp(light, (0, DARK_NOISE_LIGHT), most))
        levels = _add_noise(rng, levels * light, sigma)
    else:
        for effect in camera.noise:
            if effect.happens(rng):
                levels = _add_noise(rng, levels, effect.strength(rng))
                break
    image: np.ndarray = np.clip(np.rint(levels), 0, WHITE).astype(np.uint8)
    return compress(image, camera.jpeg.whole(rng)) if camera.jpeg.happens(rng) else image


def _add_noise(rng: np.random.Generator, levels: np.ndarray, sigma: float) -> np.ndarray:
    return levels + sigma * rng.standard_normal(levels.shape, levels.dtype.type)


def compress(image: np.ndarray, quality: int) -> np.ndarray:
    """Store a grey or RGB uint8 image as JPEG, and read it again."""
    kind = [cv2.IMWRITE_JPEG_QUALITY, quality]
    if image.ndim == 2:
        return cv2.imdecode(cv2.imencode(".jpg", image, kind)[1], cv2.IMREAD_GRAYSCALE)
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)  # OpenCV's order, so that luma is luma
    stored = cv2.imencode(".jpg", bgr, kind)[1]
    return cv2.cvtColor(cv2.imdecode(stored, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def view_homography(
    side_px: int, place: np.ndarray, linear: np.ndarray, perspective: np.ndarray
) -> np.ndarray:
    """Return the (3, 3) homography from the pixels of a square view to those of a photograph.

    The middle of the view shows the place, around which (2, 2) maps pixels of the view to those of
    the photograph, after the perspective, (2,) per pixel of the view.
    """
    affine, bent, shift = np.eye(3), np.eye(3), np.eye(3)
    affine[:2, :2], affine[:2, 2] = linear, place
    bent[2, :2] = perspective
    shift[:2, 2] = -(side_px - 1) / 2
    return affine @ bent @ shift


def rotation(angle: float) -> np.ndarray:
    """Return the (2, 2) rotation by an angle in radians, from x towards y."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])


def scaled_along(azimuth: float, along: float, across: float) -> np.ndarray:
    """Return the (2, 2) map that scales along a direction, in radians, and across it."""
    return rotation(azimuth) @ np.diag([along, across]) @ rotation(-azimuth)


def smooth_noise(rng: np.random.Generator, side_px: int, cells: tuple[int, int]) -> np.ndarray:
    """Draw (S, S) float32 normal values, interpolated between a number of cells along a side."""
    noise = rng.standard_normal((int(rng.integers(*cells)),) * 2).astype(np.float32)
    return cv2.resize(noise, (side_px, side_px), interpolation=cv2.INTER_CUBIC)


@lru_cache
def pixels(side_px: int) -> np.ndarray:
    """Return the (S, S, 2) float32 positions of a view's pixels."""
    return np.stack(np.meshgrid(*[np.arange(side_px, dtype=np.float32)] * 2), -1)
