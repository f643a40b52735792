"""Why a pair that is taken for rectified gives no depth, said in one sentence.

As `degeneracy`, for matches along rows; in the order of this module.
"""

from __future__ import annotations

import numpy as np

from ..errors import ReconstructionError
from .calibration import Calibration
from .degeneracy import IN_FRONT, stands_still

LEAST_SPREAD = 0.5
"""Pixels between the 5th and 95th percentile of the disparities of a scene with depth."""

LEAST_SURE = 0.1
LEAST_MATCHED = 0.25
"""Share of the keypoints of a rectified pair that have a match on their row, of sure matches and of
all: unrelated photographs gave up to 0.005 and 0.16, rectified pairs 0.35 and 0.64 at least."""

BEHIND = -1.0
"""Disparities, with their offset, under so many pixels put points behind the cameras."""


def check_matched(matched: int, keypoints: int, sure: bool = True) -> None:
    """Refuse a pair taken for rectified of which hardly any keypoint has a match on its row.

    Args:
        matched: number of keypoints with a match; what was filled in is none.
        keypoints: number of keypoints.
        sure: whether only matches count that no other place on the row comes near to.

    Raises:
        ReconstructionError: there are too few.
    """
    if matched < (LEAST_SURE if sure else LEAST_MATCHED) * keypoints:
        raise ReconstructionError(
            f"only {matched:,} of {keypoints:,} keypoints have a match on their row: the "
            "photographs hardly overlap or show different scenes, or the pair is not rectified"
        )


def check_disparities(disparity: np.ndarray) -> None:
    """Refuse disparities of a rectified pair that are all one value.

    Args:
        disparity: (N,) in pixels; those that are not finite do not count.

    Raises:
        ReconstructionError: there are none, or they do not differ.

    Example:
        >>> check_disparities(np.full(100, 7.0))
        Traceback (most recent call last):
        ...
        deepdetect.errors.ReconstructionError: all disparities are 7 px: one image is the other \
moved sideways, or both show one plane, and there is no depth
    """
    known = np.asarray(disparity)[np.isfinite(disparity)]
    if not len(known):
        raise ReconstructionError("no disparity was found: the images do not overlap")
    if stands_still(known):
        raise ReconstructionError(
            "all disparities are 0: both images were taken from one place, without a baseline"
        )
    low, middle, high = np.quantile(known, [0.05, 0.5, 0.95])
    if high - low >= LEAST_SPREAD:
        return
    raise ReconstructionError(
        f"all disparities are {middle:.3g} px: one image is the other moved sideways, or both "
        "show one plane, and there is no depth"
    )


def check_depths(disparity: np.ndarray, calibration: Calibration) -> None:
    """Refuse disparities of a rectified pair of which many would lie behind the cameras.

    Args:
        disparity: (N,) in pixels.
        calibration: tells the offset.

    Raises:
        ReconstructionError: left and right are exchanged, or the offset is wrong.
    """
    offset = calibration.disparity_offset_px
    behind = float(np.mean(disparity + offset < BEHIND))
    if behind > 1 - IN_FRONT:
        raise ReconstructionError(
            f"{behind:.0%} of the points would lie behind the cameras: left and right are "
            f"exchanged, or the disparity offset of {offset:g} px ({calibration.source}) is wrong"
        )
