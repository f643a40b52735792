"""Views from the side, simulated: for pairs whose viewpoints differ too much for plain SIFT.

Yu and Morel, "ASIFT: A New Framework for Fully Affine Invariant Image Comparison", 2009. One image
is seen from the side, in several directions, and compared with the other as it is; then the other
way round. Small tilts come first, and the search ends as soon as a geometry can be trusted.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from ...features.keypoints import Keypoints
from ...features.sift_detector import SiftOptions, detect_sift

TILTS = (2.0, 2.0 * 2**0.5, 4.0)
"""How many times shorter one direction is seen."""

STEP = 72.0
"""Degrees between the directions, for a tilt of 1; the larger the tilt, the finer."""

ALIAS = 0.8
"""Blur before an image is shortened, in units of sqrt(tilt^2 - 1)."""


def tilted_views(gray: np.ndarray, tilt: float, most: int) -> Iterator[Keypoints]:
    """Find the keypoints of an image as seen from the side, from directions all around.

    Args:
        gray: (H, W) uint8 luma.
        tilt: how many times shorter one direction is.
        most: keypoints of each view.

    Yields:
        The features of each view, at their positions in the image itself.
    """
    for turn in np.linspace(0, 180, round(180 * tilt / STEP), endpoint=False):
        view, to_view = tilted(gray, tilt, float(turn))
        found = detect_sift(view, SiftOptions(max_keypoints=most))
        back = cv2.invertAffineTransform(to_view)
        xy = found.xy @ back[:, :2].T.astype(np.float32) + back[:, 2].astype(np.float32)
        inside = ((xy > 0) & (xy < np.array(gray.shape[::-1]) - 1)).all(1)
        size = (gray.shape[1], gray.shape[0])
        yield Keypoints(
            *(xy[inside], found.scores[inside], size), descriptors=found.descriptors[inside]
        )


def tilted(gray: np.ndarray, tilt: float, turn: float) -> tuple[np.ndarray, np.ndarray]:
    """Turn an image and shorten it along x, blurred before as a camera would.

    Args:
        gray: (H, W) uint8 luma.
        tilt: how many times.
        turn: degrees.

    Returns:
        The view, grey outside the image, and the (2, 3) affine map from the image to it.
    """
    height, width = gray.shape
    angle = np.deg2rad(turn)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]]) @ rotation.T
    low = corners.min(0)
    across, down = np.ceil(corners.max(0) - low).astype(int)
    affine = np.column_stack([rotation, -low])
    flags = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": 128}
    turned = cv2.warpAffine(gray, affine, (int(across), int(down)), **flags)
    blur = ALIAS * np.sqrt(tilt**2 - 1)
    if blur > 0:
        turned = cv2.GaussianBlur(turned, (0, 0), sigmaX=blur, sigmaY=0.01)
    size = (max(1, round(across / tilt)), int(down))
    shrink = np.array([[1 / tilt, 0, 0], [0, 1.0, 0]])
    view = cv2.warpAffine(turned, shrink, size, flags=cv2.INTER_LINEAR, **flags)
    affine[0] /= tilt
    return view, affine
