"""Which geometry two images have: that of a plane (or of a turning camera), or that of depth."""

from __future__ import annotations

import numpy as np

DEPTH_OF_REST = 0.5
DEPTH_OF_ALL = 0.1
"""A scene has depth when the fundamental matrix explains at least half of the matches that the
homography leaves, and these are at least a tenth of all that it explains. (On planes it explains
some too, as a band is easily hit, but few of the rest.)"""


def select_model(by_homography: np.ndarray, by_fundamental: np.ndarray) -> str:
    """Return which model fits a scene: "homography" (no depth) or "fundamental".

    Args:
        by_homography, by_fundamental: (M,) bool, the inliers of each model among the same matches.

    Example:
        >>> plane = np.arange(100) < 60
        >>> select_model(plane, plane), select_model(plane, np.arange(100) < 95)
        ('homography', 'fundamental')
    """
    rest = by_fundamental & ~by_homography
    left, all_of_it = np.count_nonzero(~by_homography), np.count_nonzero(by_fundamental)
    depth = rest.sum() >= max(DEPTH_OF_REST * left, DEPTH_OF_ALL * all_of_it, 1)
    return "fundamental" if depth else "homography"
