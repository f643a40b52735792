"""Synthetic pairs of views of one photograph, with the homography between them.

Four kinds, as Oxford's scenes have: zoom and rotation, blur, viewpoint, light and JPEG. Each kind
also gets a little of the others. A pair is a pure function of photograph, kind, size and generator.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from deepdetect._shared.opencv import cv2

KINDS = ("zoom", "blur", "viewpoint", "light")

BORDER_PX = 4
"""Places this close to the photograph's border are not valid."""

SUPERSAMPLING = 2
MAX_ENLARGEMENT = 2.2
"""Of the photograph's pixels in a view that is zoomed in."""

SUBTLE = 0.25
"""Probability of blur, light or JPEG in a view whose kind does not ask for it."""


@dataclass(frozen=True, eq=False)
class ViewPair:
    """Two views of one photograph: (H, W) uint8 images, and where they show it, (H, W) bool.

    The (3, 3) homography leads from the first view to the second.
    """

    images: tuple[np.ndarray, np.ndarray]
    valid: tuple[np.ndarray, np.ndarray]
    homography: np.ndarray
    kind: str


def view_homography(
    side: int,
    center: np.ndarray,
    scale: float,
    rotation: float = 0.0,
    tilt: float = 0.0,
    azimuth: float = 0.0,
    focal: float = 2.0,
) -> np.ndarray:
    """Return the (3, 3) homography from a photograph to a view of some side in pixels.

    The view has the place `center` in its centre, and `scale` pixels per pixel of the photograph.
    The tilt is about an axis in the direction `azimuth`; the focal length is in sides.
    """
    turn = scale * _rotation(rotation)[:2, :2]
    axis = _rotation(azimuth)
    c, s = math.cos(tilt), math.sin(tilt)
    tilted = axis @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ axis.T
    focal_px = focal * side
    plane = np.vstack([focal_px * tilted[:2, :2], tilted[2, :2]])
    projection = np.column_stack([plane, [0, 0, focal_px]])
    similarity = np.eye(3)
    similarity[:2, :2] = turn
    similarity[:2, 2] = -turn @ center
    middle = (side - 1) / 2
    return np.array([[1, 0, middle], [0, 1, middle], [0, 0, 1]]) @ projection @ similarity


def _rotation(angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def draw_pair(photo: np.ndarray, kind: str, side: int, generator: np.random.Generator) -> ViewPair:
    """Draw two square views of a photograph, (H, W) uint8 grey."""
    matrices = _draw_homographies(photo.shape, kind, side, generator)
    rendered = [render(photo, matrix, side) for matrix in matrices]
    affected = int(generator.integers(2))  # the view that has most of the blur or of the light
    images = [degrade(rendered[k][0], kind if k == affected else "", generator) for k in range(2)]
    homography = matrices[1] @ np.linalg.inv(matrices[0])
    return ViewPair(
        images=(images[0], images[1]),
        valid=(rendered[0][1], rendered[1][1]),
        homography=homography / homography[2, 2],
        kind=kind,
    )


def _draw_homographies(
    shape: tuple[int, ...], kind: str, side: int, generator: np.random.Generator
) -> list[np.ndarray]:
    """Draw where both views are taken from: the homographies from the photograph."""
    height, width = shape
    smallest = side / min(height, width)  # shows all of the photograph's shorter side
    uniform = generator.uniform
    zoom, angle, tilt = math.exp(uniform(-0.1, 0.1)), math.radians(uniform(-6, 6)), 0.0
    if kind == "zoom":
        highest = min(4.0, MAX_ENLARGEMENT / smallest)
        zoom = math.exp(uniform(math.log(1.2), math.log(max(highest, 1.3))))
        angle, tilt = uniform(-math.pi, math.pi), math.radians(uniform(0, 15))
    elif kind == "viewpoint":
        zoom = math.exp(uniform(-0.25, 0.25))
        turned = generator.random() < 0.35
        angle = uniform(-math.pi, math.pi) if turned else math.radians(uniform(-25, 25))
        tilt = math.radians(uniform(15, 60))
    elif kind == "light":
        zoom, angle = math.exp(uniform(-0.03, 0.03)), math.radians(uniform(-2, 2))
        if generator.random() < 0.3:
            zoom, angle = 1.0, 0.0
    largest = max(smallest, min(1.0, MAX_ENLARGEMENT / zoom))
    scale = math.exp(uniform(math.log(smallest), math.log(largest)))
    if kind == "zoom":  # small first views, so that the second ones are not blurred
        scale = smallest * math.exp(uniform(0, 0.3) * math.log(largest / smallest))
    reach_x, reach_y = (max(0.0, (full - side / scale) / 2) for full in (width, height))
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    first = middle + uniform(-1, 1, 2) * (reach_x, reach_y)
    away = 0.08 if kind in ("blur", "light") else 0.15
    second = first + uniform(-away, away, 2) * side / scale
    if kind == "zoom":  # anywhere in the first view
        second = first + uniform(-0.3, 0.3, 2) * side / scale
    base = uniform(-math.pi, math.pi) if generator.random() < 0.2 else 0.0
    azimuth, focal = uniform(0, 2 * math.pi), uniform(1.2, 3)
    matrices = [
        view_homography(side, first, scale, base),
        view_homography(side, second, scale * zoom, base + angle, tilt, azimuth, focal),
    ]
    return matrices[::-1] if generator.random() < 0.5 else matrices


def render(photo: np.ndarray, matrix: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Render a view without aliasing: (side, side) uint8, and where it shows the photograph."""
    height, width = photo.shape
    x, y, w = np.linalg.solve(matrix, [(side - 1) / 2, (side - 1) / 2, 1])
    center = np.array([x / w, y / w])
    steps = np.array([center, center + (1, 0), center + (0, 1)])
    mapped = cv2.perspectiveTransform(steps[None], matrix)[0]
    scale = float(np.linalg.norm(np.stack([mapped[1] - mapped[0], mapped[2] - mapped[0]]), 2))
    source, to_source = photo, np.eye(3)
    if scale < 0.9:
        size = (max(8, round(width * scale)), max(8, round(height * scale)))
        source = cv2.resize(photo, size, interpolation=cv2.INTER_AREA)
        fx, fy = width / size[0], height / size[1]
        to_source = np.array([[fx, 0, fx / 2 - 0.5], [0, fy, fy / 2 - 0.5], [0, 0, 1]])
    k = SUPERSAMPLING
    finer = np.array([[k, 0, (k - 1) / 2], [0, k, (k - 1) / 2], [0, 0, 1.0]])
    large = cv2.warpPerspective(
        source,
        finer @ matrix @ to_source,
        (side * k, side * k),
        flags=cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_REFLECT_101,
    )
    inside = np.zeros((height, width), np.uint8)
    inside[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = 1
    valid = cv2.warpPerspective(inside, matrix, (side, side), flags=cv2.INTER_NEAREST)
    window = np.ones((2 * BORDER_PX + 1,) * 2, np.uint8)
    eroded = cv2.erode(valid, window, borderType=cv2.BORDER_CONSTANT, borderValue=1)
    return cv2.resize(large, (side, side), interpolation=cv2.INTER_AREA), eroded.astype(bool)


def degrade(image: np.ndarray, kind: str, generator: np.random.Generator) -> np.ndarray:
    """Blur, light, noise and JPEG of a kind in full, of the others now and then a little.

    The kind is "" where the view, (H, W) uint8, is the better one of its pair.
    """
    uniform, chance = generator.uniform, generator.random
    values = image.astype(np.float32) / 255
    if kind == "blur":
        values = cv2.GaussianBlur(values, (0, 0), uniform(0.5, 4.5))
    elif chance() < SUBTLE:
        values = cv2.GaussianBlur(values, (0, 0), uniform(0.3, 1.0))
    if kind == "light" or chance() < SUBTLE:
        strength = 1.0 if kind == "light" else 0.3
        values = _relight(values, strength, generator)
    noise = uniform(0, 0.02 if chance() < 0.5 else 0.005)
    values = values + np.float32(noise) * generator.standard_normal(values.shape, np.float32)
    quality: Any = None
    if kind == "light":
        quality = uniform(5, 60) if chance() < 0.5 else None
    elif chance() < SUBTLE:
        quality = uniform(60, 95)
    result: np.ndarray = np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8)
    if quality is not None:
        _, coded = cv2.imencode(".jpg", result, [cv2.IMWRITE_JPEG_QUALITY, int(quality)])
        result = cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE)
    return result


def _relight(values: np.ndarray, strength: float, generator: np.random.Generator) -> np.ndarray:
    """Change gamma, gain and offset, by a ramp across the image as well."""
    uniform = generator.uniform
    gamma = math.exp(strength * uniform(-0.8, 0.8))
    gain = math.exp(strength * uniform(-1.6, 0.35))
    direction = uniform(0, 2 * math.pi)
    row, column = np.indices(values.shape, np.float32) / max(values.shape) - 0.5
    ramp = math.cos(direction) * column + math.sin(direction) * row
    light = gain * (1 + strength * uniform(0, 0.8) * ramp)
    changed = values**gamma * light + strength * uniform(-0.05, 0.1)
    return changed.astype(np.float32)
