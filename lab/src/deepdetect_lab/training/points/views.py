"""Synthetic pairs of views of one photograph, with the homography between them.

The four kinds are those of Oxford's scenes: zoom and rotation, blur, viewpoint, light and JPEG.
Each kind also gets a little of the others. A pair depends on photograph, kind, size and generator.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from deepdetect._shared.opencv import cv2

from ..synthetic import (
    WHITE,
    Camera,
    Effect,
    Light,
    blur,
    happens,
    record,
    relight,
    rotation,
    scaled_along,
    view_homography,
)

KINDS = ("zoom", "blur", "viewpoint", "light")

BORDER_PX = 4
"""Places this close to the photograph's border are not valid: their candidates see what is
mirrored."""

SUPERSAMPLING = 2
"""Views are rendered with twice the pixels along each side, so that they are not aliased."""

MAX_ENLARGEMENT = 2.2
"""Zoomed views are enlarged by at most this factor, because larger ones only show blur."""

SUBTLE = 0.25
"""Share of views of other kinds with blur, light changes or JPEG. Chosen by hand."""

CAMERA = Camera(
    blur=Effect(SUBTLE, 0.3, 1.0),
    noise=(Effect(0.5, 0, 0.02 * WHITE), Effect(1, 0, 0.005 * WHITE)),
    jpeg=Effect(SUBTLE, 60, 95),
)
CAMERAS = {
    "blur": replace(CAMERA, blur=Effect(1, 0.5, 4.5)),
    "light": replace(CAMERA, jpeg=Effect(0.5, 5, 60)),
}
"""Blur, noise and JPEG of every view, and of the worse view by its kind. Oxford's JPEGs are of
quality 40 to 2, but below 5 little is left of a view of 224 pixels."""

LIGHT = Light(
    log_gamma=Effect(1, -0.8, 0.8),
    log_gain=Effect(1, -1.6, 0.35),
    ramp=Effect(1, 0, 0.8),
    shift=(-0.05, 0.1),
)
SUBTLE_LIGHT = Light(
    share=SUBTLE,
    log_gamma=Effect(1, -0.24, 0.24),
    log_gain=Effect(1, -0.48, 0.105),
    ramp=Effect(1, 0, 0.24),
    shift=(-0.015, 0.03),
)
"""Light of the worse view of its kind, with a gain down to a fifth; and of other views, 0.3 of
that."""


@dataclass(frozen=True)
class Change:
    """Changes from the first to the second view of a kind.

    Attributes:
        log_zoom: range of the logarithm of the zoom.
        turn_deg: the largest rotation, either way.
        shift: the largest distance of the middles along each axis, in sides of the first view.
        any_turn: share of the pairs that are rotated by any angle.
        tilt_deg: range of the tilt.
        still: share of the pairs with neither zoom nor rotation nor tilt.
        scales: how far first views go, on the logarithmic way from the scale that shows all of the
            photograph to the largest.
    """

    log_zoom: tuple[float, float]
    turn_deg: float
    shift: float
    any_turn: float = 0
    tilt_deg: tuple[float, float] = (0, 0)
    still: float = 0
    scales: float = 1


CHANGES = {
    # Small first views, so that the second ones, anywhere in them, are not blurred.
    "zoom": Change((math.log(1.2), math.log(4.0)), 180, 0.3, tilt_deg=(0, 15), scales=0.3),
    "blur": Change((-0.1, 0.1), 6, 0.08),
    "viewpoint": Change((-0.25, 0.25), 25, 0.15, any_turn=0.35, tilt_deg=(15, 60)),
    "light": Change((-0.03, 0.03), 2, 0.08, still=0.3),
}
"""Changes up to the largest that Oxford's scenes are described with: a viewpoint of 60 degrees, a
zoom of 4."""

LEAST_LOG_ZOOM = math.log(1.3)
"""A zoom may be this large even where the second view then is enlarged by more than it should
be."""

ROTATED_SHARE = 0.2
"""Share of the pairs that are rotated as a whole, by any angle. Chosen by hand."""

FOCAL_SIDES = (1.2, 3.0)
"""Focal length in sides of the view: fields of view from 45 to 19 degrees."""

SHRUNK_SCALE, LEAST_SIDE_PX = 0.9, 8
"""Photographs are first shrunk by area averaging if their scale is below the first number; their
sides keep at least the second number of pixels."""


@dataclass(frozen=True, eq=False)
class ViewPair:
    """Two views of one photograph: (H, W) uint8 images, and where they show it, (H, W) bool.

    The (3, 3) homography leads from the first view to the second.
    """

    images: tuple[np.ndarray, np.ndarray]
    valid: tuple[np.ndarray, np.ndarray]
    homography: np.ndarray
    kind: str


def tilted_view(
    side: int,
    center: np.ndarray,
    scale: float,
    angle: float = 0.0,
    tilt: float = 0.0,
    azimuth: float = 0.0,
    focal: float = 2.0,
) -> np.ndarray:
    """Return the (3, 3) homography from a photograph to a view of some side in pixels.

    The view has the place `center` in its centre, and `scale` pixels per pixel of the photograph.
    The tilt is about an axis in the direction `azimuth`; the focal length is in sides.
    """
    linear = rotation(-angle) @ scaled_along(azimuth, 1, 1 / math.cos(tilt)) / scale
    perspective = -math.tan(tilt) / (focal * side) * rotation(-azimuth)[1]
    return np.linalg.inv(view_homography(side, center, linear, perspective))


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
    change, uniform = CHANGES[kind], generator.uniform
    size = np.array(shape[::-1])
    smallest = side / size.min()  # shows all of the photograph's shorter side
    least, most = change.log_zoom
    largest_zoom = max(math.log(MAX_ENLARGEMENT / smallest), LEAST_LOG_ZOOM)
    zoom = math.exp(uniform(least, min(most, largest_zoom)))
    most_deg = 180 if happens(generator, change.any_turn) else change.turn_deg
    angle = math.radians(uniform(-most_deg, most_deg))
    tilt = math.radians(uniform(*change.tilt_deg))
    if happens(generator, change.still):
        zoom, angle, tilt = 1.0, 0.0, 0.0
    largest = max(smallest, min(1.0, MAX_ENLARGEMENT / zoom))
    scale = smallest * (largest / smallest) ** uniform(0, change.scales)
    reach = np.maximum(0, (size - side / scale) / 2)
    first = (size - 1) / 2 + uniform(-1, 1, 2) * reach
    second = first + uniform(-change.shift, change.shift, 2) * side / scale
    base = uniform(-math.pi, math.pi) if happens(generator, ROTATED_SHARE) else 0.0
    azimuth, focal = uniform(0, 2 * math.pi), uniform(*FOCAL_SIDES)
    matrices = [
        tilted_view(side, first, scale, base),
        tilted_view(side, second, scale * zoom, base + angle, tilt, azimuth, focal),
    ]
    return matrices[::-1] if generator.integers(2) else matrices


def render(photo: np.ndarray, matrix: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Render a view without aliasing: (side, side) uint8, and where it shows the photograph."""
    height, width = photo.shape
    x, y, w = np.linalg.solve(matrix, [(side - 1) / 2, (side - 1) / 2, 1])
    center = np.array([x / w, y / w])
    steps = np.array([center, center + (1, 0), center + (0, 1)])
    mapped = cv2.perspectiveTransform(steps[None], matrix)[0]
    scale = float(np.linalg.norm(np.stack([mapped[1] - mapped[0], mapped[2] - mapped[0]]), 2))
    source, to_source = photo, np.eye(3)
    if scale < SHRUNK_SCALE:
        size = tuple(max(LEAST_SIDE_PX, round(full * scale)) for full in (width, height))
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
    camera = CAMERAS.get(kind, CAMERA)
    values = blur(generator, image.astype(np.float32) / WHITE, camera)
    values = relight(generator, values, LIGHT if kind == "light" else SUBTLE_LIGHT)
    return record(generator, values * WHITE, camera)
