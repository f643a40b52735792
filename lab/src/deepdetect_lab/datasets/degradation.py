"""Simulate photographs in little light, out of focus, or with motion blur.

To add a degradation, write a function that takes linear light in [0, 1] and a random generator and
returns an 8-bit image. Then add it to `DEGRADATIONS`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from deepdetect._shared.image_array import srgb_to_linear
from deepdetect._shared.opencv import cv2

FULL_WELL = 10_000.0
"""A white pixel in full light collects this number of electrons in each colour, on average. Actual
numbers follow a Poisson distribution, which is the shot noise. Chosen by hand; not measured."""

READ_NOISE = 3.0
"""Standard deviation of the Gaussian read noise, in electrons. Chosen by hand; not measured."""


@dataclass(frozen=True)
class Degradation:
    """A degradation of images.

    Attributes:
        name: short name, for example "dark-8".
        title: name in tables.
        apply: function that takes (H, W, 3) float32 linear light in [0, 1] and a random generator,
            and returns an (H, W, 3) uint8 sRGB image.
        version: number to increase whenever a change of the code changes the result.
    """

    name: str
    title: str
    apply: Callable[[np.ndarray, np.random.Generator], np.ndarray]
    version: int = 1


def degrade(rgb: np.ndarray, degradation: Degradation) -> np.ndarray:
    """Return a degraded copy of an image, (H, W, 3) uint8 sRGB. Equal images give equal copies."""
    own = int.from_bytes(hashlib.sha256(rgb.tobytes()).digest()[:8], "little")
    return degradation.apply(to_linear(rgb), np.random.default_rng([0, own]))


def to_linear(rgb: np.ndarray) -> np.ndarray:
    """Convert uint8 sRGB (IEC 61966-2-1) to float32 linear light in [0, 1]."""
    return srgb_to_linear().astype(np.float32)[rgb]


def to_srgb(linear: np.ndarray) -> np.ndarray:
    """Convert linear light to uint8 sRGB."""
    light = np.clip(linear, 0, 1)
    value = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.rint(255 * value).astype(np.uint8)


def darken(linear: np.ndarray, generator: np.random.Generator, fraction: float) -> np.ndarray:
    """Simulate a photograph in a fraction of the light, with exposure and gain unchanged."""
    electrons = generator.poisson(linear * (fraction * FULL_WELL)).astype(np.float32)
    electrons += generator.normal(0, READ_NOISE, linear.shape).astype(np.float32)
    return to_srgb(electrons / FULL_WELL)


def blur_gaussian(linear: np.ndarray, _: np.random.Generator, sigma_px: float) -> np.ndarray:
    """Simulate defocus by a Gaussian blur."""
    return to_srgb(cv2.GaussianBlur(linear, (0, 0), sigma_px))


def blur_motion(linear: np.ndarray, generator: np.random.Generator, length_px: float) -> np.ndarray:
    """Simulate motion blur: the camera moves uniformly by `length_px` in a random direction."""
    return to_srgb(cv2.filter2D(linear, -1, motion_kernel(length_px, generator.uniform(0, np.pi))))


def motion_kernel(length_px: float, angle: float) -> np.ndarray:
    """Return the kernel, with sum 1, of uniform motion along a line through its middle pixel.

    `angle` is the direction of the line in radians, from the x axis towards the y axis.
    """
    radius = int(np.ceil(length_px / 2))
    kernel = np.zeros((2 * radius + 1, 2 * radius + 1), np.float64)
    along = (np.arange(256) + 0.5) / 256 * length_px - length_px / 2
    x, y = along * np.cos(angle) + radius, along * np.sin(angle) + radius
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    for right in (0, 1):
        for below in (0, 1):
            weight = (1 - abs(x - column - right)) * (1 - abs(y - row - below))
            place = np.minimum(row + below, 2 * radius), np.minimum(column + right, 2 * radius)
            np.add.at(kernel, place, weight)
    return kernel / kernel.sum()


DEGRADATIONS: dict[str, Degradation] = {
    one.name: one
    for one in (
        Degradation("dark-4", "1/4 of the light", partial(darken, fraction=1 / 4)),
        Degradation("dark-8", "1/8 of the light", partial(darken, fraction=1 / 8)),
        Degradation("blur-2", "Gaussian blur, sigma 2 px", partial(blur_gaussian, sigma_px=2)),
        Degradation("motion-9", "motion blur, 9 px", partial(blur_motion, length_px=9)),
    )
}
