"""Synthetic views for all trainings: homographies, and changes of light, blur, noise and JPEG.

This module holds the operations. How often and how strongly a training applies them is its recipe:
`Light` and `Camera`, which consist of `Effect`s.
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
"""Smooth light is interpolated from 2 to 4 random values along a side. So it varies over a quarter
to half of the view, like light in a room."""

LIT_RANGE = (0.15, 1.6)
"""Smooth light multiplies values by factors in this range. Darker areas would show nothing, and
brighter ones would be white."""

SHADOW_REACH_PX = 80.0
"""The edge of a shadow passes the middle of the view within 80 pixels, so that both sides are
seen."""

SHADOW_EDGE_PX = (0.7, 8.0)
"""The edge of a shadow is blurred by a Gaussian with a sigma from 0.7 pixels (sunlight, object
close to the surface) to 8 (light from a window)."""

CURVE_TONES = 6
"""A curve of tones rises through 6 random values between black and white."""

DARK_NOISE_LEVELS, DARK_NOISE_LIGHT = (0.2, 0.6, 3.0), 0.25
"""The first three are standard deviations of the noise of dark views, in grey levels. The smallest
is 0.2. The largest grows from 0.6 without light to 3.0 at 1/4 of the light (the second number),
because shot noise grows with the number of photons."""


def happens(rng: np.random.Generator, share: float) -> bool:
    """Draw whether an effect with this share happens; nothing is drawn if it is 0 or 1."""
    return share >= 1 or (share > 0 and rng.random() < share)


class Effect(NamedTuple):
    """An effect on views: the share of the views that get it, and the range of its strength.

    The strength is drawn uniformly if `power` is 1. A power above 1 makes low strengths more
    frequent, a power below 1 high ones.
    """

    share: float
    low: float
    high: float
    power: float = 1

    def happens(self, rng: np.random.Generator) -> bool:
        """Draw whether the effect happens to a view."""
        return happens(rng, self.share)

    def strength(self, rng: np.random.Generator) -> float:
        """Draw the strength of the effect."""
        return self.low + (self.high - self.low) * float(rng.random()) ** self.power

    def whole(self, rng: np.random.Generator) -> int:
        """Draw the strength as a whole number, excluding the upper end of the range."""
        return int(rng.integers(int(self.low), int(self.high)))


NEVER = Effect(0, 0, 0)


@dataclass(frozen=True)
class Light:
    """How `relight` changes values in [0, 1].

    Attributes:
        share: share of the views that are changed at all.
        field: smooth light. The strength is the fraction by which it varies.
        shadow: a shadow with an edge. The strength is the fraction of the light that it removes.
        log_gamma: natural logarithm of the exponent of a gamma curve.
        curve: share of the views with a random increasing tone curve.
        contrast: factor of the contrast around the middle grey.
        log_gain: natural logarithm of the factor of all values.
        ramp: light that increases linearly by this fraction from border to border.
        shift: range of the offset that is added together with a contrast or a gain.
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
    """How `blur` and `record` degrade a view.

    Attributes:
        blur: Gaussian blur. The strength is its sigma in pixels.
        motion: motion blur of views without a Gaussian blur. The strength is a length in whole
            pixels.
        log_dark: natural logarithm of the fraction of the light that is left. It adds noise.
        noise: noise of views that are not dark. The strength is the sigma in grey levels. The first
            effect that happens is used.
        jpeg: JPEG compression. The strength is the quality, a whole number.
    """

    blur: Effect = NEVER
    motion: Effect = NEVER
    log_dark: Effect = NEVER
    noise: tuple[Effect, ...] = ()
    jpeg: Effect = NEVER


def relight(rng: np.random.Generator, view: np.ndarray, light: Light) -> np.ndarray:
    """Change the light of a view, (S, S) in [0, 1].

    Without `field`, `shadow` and `ramp` values can have any shape.
    """
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
    """Blur a view of any type by defocus or motion, if the recipe's effects happen."""
    if camera.blur.happens(rng):
        return cv2.GaussianBlur(view, (0, 0), camera.blur.strength(rng))
    if camera.motion.happens(rng):
        length = camera.motion.whole(rng)
        return cv2.filter2D(view, -1, motion_kernel(length, rng.uniform(0, math.pi)))
    return view


def record(rng: np.random.Generator, levels: np.ndarray, camera: Camera) -> np.ndarray:
    """Simulate a camera: darken a float view in grey levels, add noise, compress; return uint8."""
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
    """Compress a grey or RGB uint8 image as JPEG, and decode it again."""
    kind = [cv2.IMWRITE_JPEG_QUALITY, quality]
    if image.ndim == 2:
        return cv2.imdecode(cv2.imencode(".jpg", image, kind)[1], cv2.IMREAD_GRAYSCALE)
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)  # OpenCV's order, for the luma of JPEG
    stored = cv2.imencode(".jpg", bgr, kind)[1]
    return cv2.cvtColor(cv2.imdecode(stored, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def view_homography(
    side_px: int, place: np.ndarray, linear: np.ndarray, perspective: np.ndarray
) -> np.ndarray:
    """Return the (3, 3) homography from the pixels of a square view to those of a photograph.

    The centre of the view shows the point `place` of the photograph. The perspective (2,), per
    pixel of the view, is applied first. Then `linear` (2, 2) maps offsets from the centre of the
    view to offsets from `place`.
    """
    affine, bent, shift = np.eye(3), np.eye(3), np.eye(3)
    affine[:2, :2], affine[:2, 2] = linear, place
    bent[2, :2] = perspective
    shift[:2, 2] = -(side_px - 1) / 2
    return affine @ bent @ shift


def rotation(angle: float) -> np.ndarray:
    """Return the rotation matrix (2, 2) for an angle in radians, from x towards y."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])


def scaled_along(azimuth: float, along: float, across: float) -> np.ndarray:
    """Return the matrix (2, 2) that scales along a direction, in radians, and across it."""
    return rotation(azimuth) @ np.diag([along, across]) @ rotation(-azimuth)


def smooth_noise(rng: np.random.Generator, side_px: int, cells: tuple[int, int]) -> np.ndarray:
    """Draw smooth noise, (S, S) float32: a coarse grid of normal values, interpolated.

    The number of values along a side is drawn from the range `cells`, which excludes its end.
    """
    noise = rng.standard_normal((int(rng.integers(*cells)),) * 2).astype(np.float32)
    return cv2.resize(noise, (side_px, side_px), interpolation=cv2.INTER_CUBIC)


@lru_cache
def pixels(side_px: int) -> np.ndarray:
    """Return the (S, S, 2) float32 positions of a view's pixels."""
    return np.stack(np.meshgrid(*[np.arange(side_px, dtype=np.float32)] * 2), -1)
