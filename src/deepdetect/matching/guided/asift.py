"""Simulated views, for pairs whose viewpoints differ too much for plain SIFT.

Yu and Morel, "ASIFT: A New Framework for Fully Affine Invariant Image Comparison", 2009. One image
is seen from the side, in several directions, and compared with the other as it is; then the other
way round. Small tilts come first, and the search ends as soon as a geometry can be trusted.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from ..._shared.machine import processor_count
from ..._shared.opencv import cv2
from ...features.keypoints import Keypoints
from ...features.sift import detect_sift

BLUR = 0.8
"""Sigma of the blur before an image is shortened, in units of sqrt(tilt^2 - 1)."""

GRAY_OUTSIDE = 128

TILTS = (2.0, 4.0)
"""Of the simulated views: how many times shorter one direction is seen."""

ROTATION_STEP_DEG = 72.0
"""Between the directions of the views for a tilt of 1; it is inversely proportional to the tilt."""


def simulated_views(gray: np.ndarray, tilt: float, max_keypoints: int) -> Iterator[Keypoints]:
    """Yield the described keypoints of views from the side, at their positions in the image."""

    def see(rotation_deg: float) -> Keypoints:
        view, to_view = simulate_view(gray, tilt, rotation_deg)
        keypoints = detect_sift(view, max_keypoints)
        back = cv2.invertAffineTransform(to_view)
        xy = keypoints.xy @ back[:, :2].T.astype(np.float32) + back[:, 2].astype(np.float32)
        size = gray.shape[1], gray.shape[0]
        moved = replace(keypoints, xy=xy, image_size=size, sizes=None, angles=None)
        return moved[((xy > 0) & (xy < np.array(size) - 1)).all(1)]

    directions = round(180 * tilt / ROTATION_STEP_DEG)
    rotations = np.linspace(0, 180, directions, endpoint=False).tolist()
    with ThreadPoolExecutor(processor_count()) as pool:
        yield from pool.map(see, rotations)


def simulate_view(
    gray: np.ndarray, tilt: float, rotation_deg: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rotate an image and shorten it along x, blurred before as by a camera.

    Returns the view, gray outside the image, and the (2, 3) affine map from the image to it.
    """
    height, width = gray.shape
    angle = np.deg2rad(rotation_deg)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]]) @ rotation.T
    low = corners.min(0)
    across, down = np.ceil(corners.max(0) - low).astype(int).tolist()
    affine = np.column_stack([rotation, -low])
    border = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": GRAY_OUTSIDE}
    rotated = cv2.warpAffine(gray, affine, (across, down), **border)
    blur = BLUR * np.sqrt(tilt**2 - 1)
    rotated = cv2.GaussianBlur(rotated, (0, 0), sigmaX=blur, sigmaY=0.01)
    shorten = np.array([[1 / tilt, 0, 0], [0, 1.0, 0]])
    size = max(1, round(across / tilt)), down
    view = cv2.warpAffine(rotated, shorten, size, flags=cv2.INTER_LINEAR, **border)
    affine[0] /= tilt
    return view, affine
