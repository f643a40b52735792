"""Augmentation: darkening, transposition, colour changes that keep luma, and augmented views."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageEnhance

from deepdetect._shared.opencv import cv2
from deepdetect.io.image import luma

from .synthetic import WHITE, Camera, Effect, Light, blur, record, relight

RED, GREEN, BLUE = 0.299, 0.587, 0.114  # weights of the luma (BT.601)

AUGMENTATION_VERSION = 3
"""This version is part of the names of augmented views and of their label files. Increase it when
`augment` changes, because existing labels then no longer fit the views."""


@dataclass(frozen=True)
class Darkening:
    """Two factors in (0, 1] for Pillow's `ImageEnhance.Brightness` and `.Contrast`.

    Brightness 0.3 and contrast 0.4 reproduce the published dark images.
    """

    brightness: float
    contrast: float


BRIGHTNESS, CONTRAST = (0.2, 0.45), (0.3, 0.55)
"""Ranges of the two factors of a `Darkening`. The product of the factors is below 0.25, so a
darkened image spans fewer than 64 of the 256 grey levels: low visibility (`visibility_of`)."""

EXPOSURE = (0.05, 0.24)
"""Range of the brightness factor of a short exposure; its contrast factor is 1. At 0.24, an image
that spans all grey levels just counts as one of low visibility. 0.05 is chosen by hand."""

TURN_PROBABILITY = 0.5
"""Share of the augmented views that are rotated by an arbitrary angle. All other views are rotated
by multiples of 90 degrees, because interpolation blurs views at other angles. Chosen by hand."""

CROP_SCALE = (0.7, 1.0)
"""Range of the cropped square's side, in units of the largest possible side. Chosen by hand."""

INTERPOLATIONS = ("NEAREST", "LINEAR", "CUBIC", "AREA", "LANCZOS4")
"""Names of OpenCV's interpolations, `cv2.INTER_...`. If a view is not rotated by an arbitrary
angle, one of these interpolations is drawn at random to downscale the view."""

LIGHT = Light(
    share=0.5,
    log_gamma=Effect(1, -0.5, 0.5),
    contrast=Effect(1, 0.5, 1.2),
    shift=(-0.15, 0.15),
)
CAMERA = Camera(blur=Effect(0.3, 0.5, 2.5), noise=(Effect(0.25, 1, 8),), jpeg=Effect(0.35, 20, 95))
"""Ranges of the changes of light and camera in augmented views. Chosen by hand; not measured."""

READ_NOISE, SHOT_NOISE = (math.log(0.5), math.log(14.0)), (0.0, 1.0)
"""`READ_NOISE` is the range of the natural logarithm of the read noise's standard deviation in grey
levels, `SHOT_NOISE` the range of the variance that shot noise adds per grey level of the image. A
phone's values at night are about log(8) and 0.5."""

MAX_JITTER_SATURATION = 1.2
"""A hue rotation also scales the saturation by a random factor up to this one. Chosen by hand."""


def draw_darkening(generator: np.random.Generator) -> Darkening:
    """Draw brightness and contrast, rounded to thousandths to keep file names short."""
    return Darkening(
        round(float(generator.uniform(*BRIGHTNESS)), 3),
        round(float(generator.uniform(*CONTRAST)), 3),
    )


def draw_exposure(generator: np.random.Generator) -> Darkening:
    """Draw the brightness of a short exposure, uniform in stops."""
    low, high = EXPOSURE
    return Darkening(round(float(low * (high / low) ** generator.uniform()), 3), 1.0)


def darken(rgb: np.ndarray, darkening: Darkening) -> np.ndarray:
    """Reduce the brightness, then the contrast, of (H, W, 3) uint8 (paper, Section III-B)."""
    dim = ImageEnhance.Brightness(Image.fromarray(rgb)).enhance(darkening.brightness)
    return np.asarray(ImageEnhance.Contrast(dim).enhance(darkening.contrast))


def transpose(image: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mirror a crop and its label along the main diagonal.

    The mirrored label is what all label detectors except BRISK would find in the mirrored crop.
    """
    # `cv2.transpose` is a hundred times faster than copying a transposed NumPy array.
    return cv2.transpose(image), cv2.transpose(mask.view(np.uint8)).view(bool)


def jitter_color(rgb: np.ndarray, generator: np.random.Generator, exact: bool) -> np.ndarray:
    """Remove the colours or rotate the hue of (H, W, 3) uint8 RGB, and keep the luma.

    With `exact`, colours are always removed, because a hue rotation may change the luma by one grey
    level, which would change the label of a dark image.
    """
    if exact or generator.random() < 0.5:
        return cv2.cvtColor(luma(rgb), cv2.COLOR_GRAY2RGB)
    angle = generator.uniform(0, 2 * np.pi)
    return rotate_hue(rgb, angle, generator.uniform(0, MAX_JITTER_SATURATION))


def add_sensor_noise(rgb: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Add read and shot noise to (H, W, 3) uint8; in half of the cases, channels vary together."""
    read, gain = math.exp(generator.uniform(*READ_NOISE)), generator.uniform(*SHOT_NOISE)
    channels = int(generator.choice([1, 3]))
    noise = generator.standard_normal((*rgb.shape[:2], channels), np.float32)
    noisy = rgb + np.sqrt(read**2 + gain * rgb.astype(np.float32)) * noise
    return np.clip(np.rint(noisy), 0, WHITE).astype(np.uint8)


def rotate_hue(rgb: np.ndarray, angle: float, saturation: float) -> np.ndarray:
    """Rotate the colours of (H, W, 3) uint8 RGB by an angle in the plane of Cb and Cr.

    Rounding changes the luma by at most one level. Colours outside of the uint8 range are
    desaturated until they fit.
    """
    red, green, blue = cv2.split(rgb.astype(np.float32))
    gray = RED * red + GREEN * green + BLUE * blue
    # Blue minus grey and red minus grey, divided by their ranges, are Cb and Cr.
    blue_range, red_range = 1 - BLUE, 1 - RED
    blue, red = (blue - gray) / blue_range, (red - gray) / red_range
    cosine, sine = saturation * math.cos(angle), saturation * math.sin(angle)
    blue, red = blue_range * (cosine * blue - sine * red), red_range * (sine * blue + cosine * red)
    green = -(RED * red + BLUE * blue) / GREEN
    # In each pixel, `above` and `below` are the largest difference from grey in a channel, divided
    # by the largest difference that fits uint8.
    above = np.maximum(np.maximum(red, green), blue) / np.maximum(255 - gray, 1e-6)
    below = np.minimum(np.minimum(red, green), blue) / np.minimum(-gray, -1e-6)
    scale = 1 / np.maximum(np.maximum(above, below), 1)
    rotated = cv2.merge([gray + scale * plane for plane in (red, green, blue)])
    return cv2.convertScaleAbs(rotated)


def augment(rgb: np.ndarray, side: int, seed: int) -> np.ndarray:
    """Make a (side, side, 3) uint8 view of a random part of an image, with random augmentations.

    The view may be rotated, relit, blurred, noisy or compressed. Its label is made from the view
    itself. Other versions of NumPy and OpenCV may give slightly different views for the same seed.
    """
    generator = np.random.default_rng([AUGMENTATION_VERSION, seed])
    turned = generator.random() < TURN_PROBABILITY
    view = (_rotated_crop if turned else _upright_crop)(rgb, side, generator)
    levels = relight(generator, np.arange(WHITE + 1) / WHITE, LIGHT)
    view = np.clip(np.rint(WHITE * levels), 0, WHITE).astype(np.uint8)[view]
    return record(generator, blur(generator, view, CAMERA).astype(np.float64), CAMERA)


def _rotated_crop(rgb: np.ndarray, side: int, generator: np.random.Generator) -> np.ndarray:
    """Crop a square at a random angle, with all corners inside the image."""
    angle = generator.uniform(0, 2 * math.pi)
    cosine, sine = math.cos(angle), math.sin(angle)
    extent = abs(cosine) + abs(sine)  # side of the bounding box of a rotated unit square
    window = (min(rgb.shape[:2]) - 1) / extent * generator.uniform(*CROP_SCALE)
    step = window / side
    if step > 1:  # shrink by area averaging first, against aliasing
        factor = 1 / step
        size = (max(round(rgb.shape[1] * factor), 1), max(round(rgb.shape[0] * factor), 1))
        rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
        window = min(window * factor, (min(rgb.shape[:2]) - 1) / extent)
        step = window / side
    half = window * extent / 2
    height, width = rgb.shape[:2]
    centre = (
        generator.uniform(half, max(width - 1 - half, half)),
        generator.uniform(half, max(height - 1 - half, half)),
    )
    linear = step * np.array([[cosine, -sine], [sine, cosine]])
    offset = np.array(centre) - linear @ np.full(2, (side - 1) / 2)
    return cv2.warpAffine(
        rgb,
        np.column_stack([linear, offset]),
        (side, side),
        flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REFLECT_101,
    )


def _upright_crop(rgb: np.ndarray, side: int, generator: np.random.Generator) -> np.ndarray:
    largest = min(rgb.shape[:2])
    window = max(round(largest * generator.uniform(*CROP_SCALE)), min(side, largest))
    top, left = (int(generator.integers(length - window + 1)) for length in rgb.shape[:2])
    view = rgb[top : top + window, left : left + window]
    view = np.rot90(view[:, :: int(generator.choice([-1, 1]))], int(generator.integers(4)))
    interpolation = cv2.INTER_CUBIC
    if window > side:
        name = INTERPOLATIONS[int(generator.integers(len(INTERPOLATIONS)))]
        interpolation = getattr(cv2, f"INTER_{name}")
    return cv2.resize(np.ascontiguousarray(view), (side, side), interpolation=interpolation)
