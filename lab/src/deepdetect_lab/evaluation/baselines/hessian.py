"""Detect maxima of |det Hessian| at one scale or at several scales, ranked by this response.

This baseline is simple and needs no training, so a learned ranking of keypoints must beat it.
"""

from __future__ import annotations

import numpy as np

from deepdetect._shared.opencv import cv2
from deepdetect.features.keypoints import Keypoints
from deepdetect.features.selection import SelectionOptions, select_keypoints, suppress_neighbors
from deepdetect.io.image import luma

from .method import PAPER_DESCRIPTOR, LocalFeature, OwnScaleDescriptor

SIGMA_PX = 3.0
"""Gaussian sigma in pixels of the baseline with a single scale. Chosen by hand."""

SIGMAS_PX = tuple(float(sigma) for sigma in np.geomspace(1.5, 9.1, 7))
"""Gaussian sigmas in pixels of the baseline with several scales. Successive sigmas differ by a
factor of 1.35. Chosen by hand."""

NMS_RADIUS = 2
DISTANCE_PX = 2.0
"""Keypoints of equal or different scales are at least this many pixels apart. Chosen by hand."""

SIZE_PER_SIGMA = 5.0
"""Diameter of a keypoint, divided by the sigma of its scale. Chosen by hand."""


def hessian_response(gray: np.ndarray, sigma_px: float) -> np.ndarray:
    """Compute the scale-normalised response |det Hessian| sigma^4 of an image, (H, W) float32."""
    scaled = gray.astype(np.float32) / 255 if gray.dtype == np.uint8 else gray
    smooth = cv2.GaussianBlur(scaled, (0, 0), sigma_px)
    second = np.array([[1, -2, 1]], np.float32)
    diagonal = np.array([[1, 0, -1], [0, 0, 0], [-1, 0, 1]], np.float32) / 4
    xx, yy, xy = (cv2.filter2D(smooth, -1, kernel) for kernel in (second, second.T, diagonal))
    return np.abs(xx * yy - xy * xy) * np.float32(sigma_px**4)


def detect_hessian(gray: np.ndarray, sigma_px: float = SIGMA_PX) -> Keypoints:
    """Detect maxima of `hessian_response` in windows of 5x5 pixels, with sub-pixel positions."""
    response = hessian_response(gray, sigma_px)
    options = SelectionOptions(threshold=0, nms_radius=NMS_RADIUS, subpixel=True)
    found = select_keypoints(response, options)
    sizes = np.full(len(found), SIZE_PER_SIGMA * sigma_px, np.float32)
    return Keypoints(found.xy, found.scores, found.image_size, sizes=sizes)


def detect_hessian_scales(gray: np.ndarray) -> Keypoints:
    """Detect maxima at each scale; drop those near a keypoint of any scale with a higher score."""
    scales = [detect_hessian(gray, sigma) for sigma in SIGMAS_PX]
    xy, scores = (np.concatenate([getattr(p, name) for p in scales]) for name in ("xy", "scores"))
    sizes = np.repeat([SIZE_PER_SIGMA * sigma for sigma in SIGMAS_PX], [len(p) for p in scales])
    kept = suppress_neighbors(xy, scores, DISTANCE_PX)
    return Keypoints(xy[kept], scores[kept], scales[0].image_size, sizes=sizes[kept])


HESSIAN: dict[str, LocalFeature] = {
    name: LocalFeature(
        name,
        title,
        detect,
        PAPER_DESCRIPTOR.describe,
        own_scale=OwnScaleDescriptor(0.5),  # as for SIFT: both sizes are about twice the sigma
    )
    for name, title, detect in (
        ("hessian", f"|det Hessian|, sigma {SIGMA_PX:g}", lambda rgb: detect_hessian(luma(rgb))),
        (
            "hessian-scales",
            f"|det Hessian|, {len(SIGMAS_PX)} scales",
            lambda rgb: detect_hessian_scales(luma(rgb)),
        ),
    )
}
"""The Hessian baselines by name. Only the standard protocol uses them."""
