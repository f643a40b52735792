"""Synthetic pairs of views of one photograph, with the homography between them.

Pairs have one of four kinds of change, as the Oxford scenes have: zoom and rotation, blur,
viewpoint, or light and JPEG. Pairs of each kind also get weak changes of the other kinds.
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
"""Pixels of a view are not valid near the photograph's border, because mirrored pixels are close.
The margin is 4 pixels of the photograph plus 4 pixels of the view. Chosen by hand."""

SUPERSAMPLING = 2
"""Views are rendered with twice the pixels along each side, so that they are not aliased."""

MAX_ENLARGEMENT = 2.2
"""Zoomed views enlarge the photograph by at most this factor, because more would only show blur."""

SUBTLE = 0.25
"""Probability that a view of another kind than "blur" is also blurred weakly. Views of other kinds
than "light" get a weak change of light, and weak JPEG compression, with this probability each.
Chosen by hand."""

CAMERA = Camera(
    blur=Effect(SUBTLE, 0.3, 1.0),
    noise=(Effect(0.5, 0, 0.02 * WHITE), Effect(1, 0, 0.005 * WHITE)),
    jpeg=Effect(SUBTLE, 60, 95),
)
CAMERAS = {
    "blur": replace(CAMERA, blur=Effect(1, 0.5, 4.5)),
    "light": replace(CAMERA, jpeg=Effect(0.5, 5, 60)),
}
"""`CAMERAS` degrade the worse view of "blur" and "light" pairs, `CAMERA` all other views. The JPEG
quality of the Oxford scenes goes from 40 to 2, but below 5 little is left of a small view."""

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
"""`LIGHT` changes the worse view in a pair of the kind "light". Its gain goes down to a fifth.
`SUBTLE_LIGHT` is for all other views. Its ranges are 0.3 times as large."""


@dataclass(frozen=True)
class Change:
    """Changes from the first to the second view in pairs of one kind.

    Attributes:
        log_zoom: range of the logarithm of the zoom.
        turn_deg: the largest rotation in either direction, in degrees.
        shift: the largest offset of the second view along each axis, in sides of the first view.
        any_turn: share of the pairs that are rotated by any angle, up to 180 degrees.
        tilt_deg: range of the tilt in degrees.
        still: share of the pairs with neither zoom nor rotation nor tilt.
        scales: upper limit of the first view's scale on a logarithmic axis: 0 is the scale that
            shows the whole shorter side of the photograph, 1 is the largest scale allowed.
    """

    log_zoom: tuple[float, float]
    turn_deg: float
    shift: float
    any_turn: float = 0
    tilt_deg: tuple[float, float] = (0, 0)
    still: float = 0
    scales: float = 1


CHANGES = {
    # First views show much of the photograph (`scales`), so that zoomed views are not blurred.
    "zoom": Change((math.log(1.2), math.log(4.0)), 180, 0.3, tilt_deg=(0, 15), scales=0.3),
    "blur": Change((-0.1, 0.1), 6, 0.08),
    "viewpoint": Change((-0.25, 0.25), 25, 0.15, any_turn=0.35, tilt_deg=(15, 60)),
    "light": Change((-0.03, 0.03), 2, 0.08, still=0.3),
}
"""Changes between the views of a pair, by kind. They go up to the largest changes in the Oxford
scenes: a viewpoint change of 60 degrees and a zoom of 4."""

LEAST_LOG_ZOOM = math.log(1.3)
"""`MAX_ENLARGEMENT` never limits the log zoom to less than this. Chosen by hand."""

ROTATED_SHARE = 0.2
"""Share of the pairs in which one random rotation is added to both views. Chosen by hand."""

FOCAL_SIDES = (1.2, 3.0)
"""Range of focal lengths in units of the view's side: fields of view of 45 to 19 degrees. Chosen by
hand."""

SHRUNK_SCALE, LEAST_SIDE_PX = 0.9, 8
"""If a view shows the photograph at a scale below `SHRUNK_SCALE`, the photograph is first shrunk to
that scale by area averaging. Its sides keep at least `LEAST_SIDE_PX` pixels. Chosen by hand."""


@dataclass(frozen=True, eq=False)
class ViewPair:
    """Two grey views of one photograph, (H, W) uint8, with the homography between them.

    `valid` holds a mask (H, W) of each view: the pixels that show the photograph. The homography
    (3, 3) maps positions in the first view to the second.
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
    """Return the homography (3, 3) from a photograph to a square view with `side` pixels a side.

    The point `center` of the photograph is in the centre of the view, which has `scale` pixels per
    pixel of the photograph. The tilt is about an axis in the direction `azimuth`. All angles are in
    radians, and the focal length is in sides of the view.
    """
    linear = rotation(-angle) @ scaled_along(azimuth, 1, 1 / math.cos(tilt)) / scale
    perspective = -math.tan(tilt) / (focal * side) * rotation(-azimuth)[1]
    return np.linalg.inv(view_homography(side, center, linear, perspective))


def draw_pair(photo: np.ndarray, kind: str, side: int, generator: np.random.Generator) -> ViewPair:
    """Draw two square views with `side` pixels a side of a grey photograph, (H, W) uint8."""
    matrices = _draw_homographies(photo.shape, kind, side, generator)
    rendered = [render(photo, matrix, side) for matrix in matrices]
    affected = int(generator.integers(2))  # the view with the strong blur or light change
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
    """Draw the homographies from the photograph to both views."""
    change, uniform = CHANGES[kind], generator.uniform
    size = np.array(shape[::-1])
    smallest = side / size.min()  # the scale that shows the whole shorter side
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
    """Render a view without aliasing; return it, (side, side) uint8, and its valid pixels."""
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
    """Degrade a view, (H, W) uint8: strongly by the change of its kind, sometimes weakly by others.

    The kind is "" for the better view of a pair, which is only degraded weakly.
    """
    camera = CAMERAS.get(kind, CAMERA)
    values = blur(generator, image.astype(np.float32) / WHITE, camera)
    values = relight(generator, values, LIGHT if kind == "light" else SUBTLE_LIGHT)
    return record(generator, values * WHITE, camera)
