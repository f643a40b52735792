"""Operations for synthetic views: homographies, and changes of light, blur, noise and JPEG.

A `Light` and a `Camera` consist of `Effect`s, which set how often and how strongly views change.
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
"""Contrast is scaled around this value of [0, 1], so that the mean brightness hardly changes."""

NOISE_CELLS = (2, 5)
"""Smooth changes of light are interpolated from 2 to 4 random values along a side of the view. So
bright and dark areas are a quarter to half as wide as the view, like light in a room."""

LIT_RANGE = (0.15, 1.6)
"""Smooth changes of light multiply the values of a view by factors in this range. Darker areas
would show nothing, and brighter areas would be white."""

SHADOW_REACH_PX = 80.0
"""The edge of a shadow passes the middle of the view at a distance of up to 80 pixels, so that the
view shows both sides of the edge."""

SHADOW_EDGE_PX = (0.7, 8.0)
"""The edge of a shadow is blurred by a Gaussian. Its sigma ranges from 0.7 pixels (sunlight, and an
object close to the surface) to 8 pixels (light from a window)."""

CURVE_TONES = 6
"""A tone curve rises from black to white through 6 random grey levels. Chosen by hand."""

DARK_NOISE_LEVELS, DARK_NOISE_LIGHT = (0.2, 0.6, 3.0), 0.25
"""The sigma of the noise in dark views is drawn between 0.2 grey levels and a maximum. The maximum
grows from 0.6 without light to 3.0 at the fraction `DARK_NOISE_LIGHT` of the light, because shot
noise grows with the number of photons. Chosen by hand."""


def happens(rng: np.random.Generator, share: float) -> bool:
    """Draw whether an effect with probability `share` happens; 0 and 1 draw no random number."""
    return share >= 1 or (share > 0 and rng.random() < share)


class Effect(NamedTuple):
    """An effect on views: the share of the views that get it, and the range of its strength.

    If `power` is 1, the strength is drawn uniformly. With a power above 1, strengths near `low` are
    more frequent; with a power below 1, strengths near `high`.
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
    """How `relight` changes the light of a view, which has values in [0, 1].

    Attributes:
        share: share of the views that are changed at all.
        field: smooth changes of light. The strength is the largest change, as a fraction.
        shadow: a shadow with an edge. The strength is the fraction of the light that it removes.
        log_gamma: a gamma curve. The strength is the natural logarithm of its exponent.
        curve: share of the views that get a random increasing tone curve.
        contrast: a change of contrast around `MIDDLE_GREY`. The strength is its factor.
        log_gain: a factor on all values. The strength is its natural logarithm.
        ramp: a linear increase of light across the view. The strength is the fraction by which the
            light differs between opposite borders.
        shift: range of an offset. It is added only if the contrast or the gain is changed.
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
        motion: motion blur, if there is no Gaussian blur. The strength is its length in pixels.
        log_dark: darkening, with the noise of dark views. The strength is the natural logarithm of
            the fraction of the light that is left.
        noise: noise of views that are not darkened. The strength is its sigma in grey levels. Only
            the first of these effects that happens is applied.
        jpeg: JPEG compression. The strength is the quality, a whole number.
    """

    blur: Effect = NEVER
    motion: Effect = NEVER
    log_dark: Effect = NEVER
    noise: tuple[Effect, ...] = ()
    jpeg: Effect = NEVER


def relight(rng: np.random.Generator, view: np.ndarray, light: Light) -> np.ndarray:
    """Change the light of a view, (S, S) with values in [0, 1].

    If `light` has no `field`, `shadow` or `ramp`, the view can have any shape.
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
    """Blur a view by defocus or by motion, if one of these effects of the camera happens."""
    if camera.blur.happens(rng):
        return cv2.GaussianBlur(view, (0, 0), camera.blur.strength(rng))
    if camera.motion.happens(rng):
        length = camera.motion.whole(rng)
        return cv2.filter2D(view, -1, motion_kernel(length, rng.uniform(0, math.pi)))
    return view


def record(rng: np.random.Generator, levels: np.ndarray, camera: Camera) -> np.ndarray:
    """Darken a float view in grey levels, add noise and compress it, at random; return uint8."""
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
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)  # OpenCV expects BGR to compute the luma
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
    """Return the rotation matrix (2, 2) for an angle in radians, from the x to the y axis."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])


def scaled_along(azimuth: float, along: float, across: float) -> np.ndarray:
    """Return the (2, 2) matrix that scales by `along` in a direction, by `across` at right angles.

    `azimuth` is the angle from the x axis to the direction, in radians.
    """
    return rotation(azimuth) @ np.diag([along, across]) @ rotation(-azimuth)


def smooth_noise(rng: np.random.Generator, side_px: int, cells: tuple[int, int]) -> np.ndarray:
    """Draw smooth noise, (S, S) float32: normally distributed values on a grid, interpolated.

    The number of values along a side is drawn from the range `cells`, which excludes its end.
    """
    noise = rng.standard_normal((int(rng.integers(*cells)),) * 2).astype(np.float32)
    return cv2.resize(noise, (side_px, side_px), interpolation=cv2.INTER_CUBIC)


@lru_cache
def pixels(side_px: int) -> np.ndarray:
    """Return the positions, (S, S, 2) float32 x and y, of the pixels of a view."""
    return np.stack(np.meshgrid(*[np.arange(side_px, dtype=np.float32)] * 2), -1)
