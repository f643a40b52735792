"""Varied views: a part of a photograph, turned, relit, blurred, noisy, compressed.

Detectors that look at single pixels mark a turned or blurred photograph quite differently, so each
varied view has something new to learn from. Its label is made from the varied view itself. Noise,
interpolation and compression are numpy's and OpenCV's: other versions of them may give slightly
other views of the same seed.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

VERSION = 2
"""Part of the names of varied views: another drawing must not get the labels of this one."""


def vary(rgb: np.ndarray, side: int, seed: int) -> np.ndarray:
    """Make a varied view of a photograph.

    Args:
        rgb: (H, W, 3) uint8 RGB.
        side: of the view, in pixels.
        seed: decides everything that is drawn.

    Returns:
        (side, side, 3) uint8 RGB, all of it from inside the photograph.

    Example:
        >>> vary(np.full((64, 96, 3), 90, np.uint8), 32, seed=1).shape
        (32, 32, 3)
    """
    generator = np.random.default_rng([VERSION, seed])
    view = _turned(rgb, side, generator)
    if generator.random() < 0.5:
        view = _relit(view, generator)
    if generator.random() < 0.3:
        view = cv2.GaussianBlur(view, (0, 0), generator.uniform(0.5, 2.5))
    if generator.random() < 0.25:
        noise = generator.normal(0, generator.uniform(1, 8), view.shape)
        view = np.clip(np.rint(view + noise), 0, 255).astype(np.uint8)
    if generator.random() < 0.35:
        view = _compressed(view, int(generator.integers(20, 95)))
    return view


def _turned(rgb: np.ndarray, side: int, generator: np.random.Generator) -> np.ndarray:
    """Cut out a square at any angle: its corners lie inside the photograph."""
    angle = generator.uniform(0, 2 * math.pi)
    cosine, sine = math.cos(angle), math.sin(angle)
    widest = (min(rgb.shape[:2]) - 1) / (abs(cosine) + abs(sine))
    window = widest * generator.uniform(0.7, 1.0)
    step = window / side
    if step > 1:  # averaged before it is sampled more coarsely
        factor = 1 / step
        size = (max(round(rgb.shape[1] * factor), 1), max(round(rgb.shape[0] * factor), 1))
        rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
        window = min(window * factor, (min(rgb.shape[:2]) - 1) / (abs(cosine) + abs(sine)))
        step = window / side
    half = window * (abs(cosine) + abs(sine)) / 2
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


def _relit(rgb: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Change gamma, contrast and brightness, by a table of 256 entries."""
    levels = np.arange(256) / 255
    levels = levels ** math.exp(generator.uniform(-0.5, 0.5))
    levels = 0.5 + (levels - 0.5) * generator.uniform(0.5, 1.2) + generator.uniform(-0.15, 0.15)
    return np.clip(np.rint(255 * levels), 0, 255).astype(np.uint8)[rgb]


def _compressed(rgb: np.ndarray, quality: int) -> np.ndarray:
    """Store as JPEG and read again."""
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)  # OpenCV's order, so that luma is luma
    _, stored = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return cv2.cvtColor(cv2.imdecode(stored, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
