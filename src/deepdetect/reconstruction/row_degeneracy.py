"""Why a pair that is taken for rectified gives no depth, said in one sentence.

As `degeneracy`, for matches along rows; in the order of this module.
"""

from __future__ import annotations

import cv2
import numpy as np

from .._shared.errors import ReconstructionError
from ..features.selection import SelectionOptions, grid_subsample
from ..geometry.camera import Calibration
from .checks import CELL, IN_FRONT, stands_still

FOCAL_DIFFERENCE = 0.01
"""Share by which the focal lengths of both views may differ. Rectified views have one; lengths
given to three digits pass, and at this bound a row is off by 2 px at the edge of 400 rows."""

CENTRE_DIFFERENCE = 2.0
"""Pixels by which cy of both views may differ: twice what a match may be off its row."""

LEAST_SPREAD = 0.5
"""Pixels between the 5th and 95th percentile of the disparities of a scene with depth."""

LEAST_SURE = 0.1
LEAST_MATCHED = 0.25
"""Share of the keypoints of a rectified pair that have a match on their row, of sure matches and of
all: unrelated photographs gave up to 0.005 and 0.16, rectified pairs 0.35 and 0.64 at least."""

BEHIND = -1.0
"""Disparities, with their offset, under so many pixels put points behind the cameras."""

BY_TURN = 0.3
MOSTLY = 0.5
THAN_PLANE = 0.5
"""A turn of the camera explains disparities when more than this share of them is within so many
pixels of it, and their median error is under this share of that of the best plane in disparity:
walls are such planes, a turn bends them. Chosen on four views turned by half a degree to two (share
0.64, ratio 0.33 at worst) and as many drawn on slanted walls before two cameras (ratio 5.3 at
least); Motorcycle and seven scenes of Middlebury ask for turns that would leave the rows."""

OFF_ROW = 1.0
"""Pixels that a turn may take half of the matches off their rows: on rows they were found."""

STEPS = 12
FEWEST, MANY = 30, 50_000
"""Steps of the robust fits; matches, one a cell, that they need, and of how many these are drawn.
"""


def check_cameras(calibration: Calibration) -> None:
    """Refuse a calibration that no rectified pair has.

    Args:
        calibration: of a pair taken for rectified.

    Raises:
        ReconstructionError: focal lengths or cy of both views differ.

    Example:
        >>> from .calibration import Camera
        >>> check_cameras(Calibration(Camera((640, 480), 500), Camera((640, 480), 600)))
        Traceback (most recent call last):
        ...
        deepdetect.ReconstructionError: the focal lengths of the left and the right view \
are 500 and 600 px, those of a rectified pair are one: mend the calibration (given), or give \
--not-rectified (rectified=False)
    """
    camera0, camera1 = calibration.camera0, calibration.camera1
    advice = (
        f"mend the calibration ({calibration.source}), or give --not-rectified (rectified=False)"
    )
    for focal0, focal1 in zip(camera0.focal_px, camera1.focal_px, strict=True):
        if abs(focal1 - focal0) > FOCAL_DIFFERENCE * focal0:
            raise ReconstructionError(
                f"the focal lengths of the left and the right view are {focal0:g} and {focal1:g} "
                f"px, those of a rectified pair are one: {advice}"
            )
    cy0, cy1 = camera0.centre[1], camera1.centre[1]
    if abs(cy1 - cy0) > CENTRE_DIFFERENCE:
        raise ReconstructionError(
            f"cy of the left and the right view are {cy0:g} and {cy1:g} px, those of a rectified "
            f"pair are one: {advice}"
        )


def check_keypoints(keypoints: int, selection: SelectionOptions) -> None:
    """Refuse an image without keypoints.

    Args:
        keypoints: their number.
        selection: how they were chosen.

    Raises:
        ReconstructionError: there are none.
    """
    if keypoints:
        return
    if selection.density is not None:
        raise ReconstructionError(
            f"a density of {selection.density:g} gives no keypoint in the left image: give a "
            "larger one"
        )
    raise ReconstructionError(
        f"no pixel of the left image is above the threshold of {selection.threshold:g}: lower it, "
        "or give a density (an image of one grey level shows nothing)"
    )


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
        deepdetect.ReconstructionError: all disparities are 7 px: one image is the other \
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


def check_turn(pixels: np.ndarray, disparity: np.ndarray, calibration: Calibration) -> None:
    """Refuse disparities that a camera which only turned explains.

    A turn by an angle a about the vertical moves pixels along their rows by f a (1 + x^2) at first
    order, x the slope of the ray: about like a wall, but bent. With a focal length that is far off,
    with a tilt besides that takes matches off their rows, or when it bends by less than the noise,
    a turn goes unseen.

    Args:
        pixels: (N, 2) positions in the left image.
        disparity: (N,) their disparities in pixels.
        calibration: tells the rays.

    Raises:
        ReconstructionError: one turn explains most disparities, and far better than a plane.
    """
    rows = np.arange(len(pixels))
    if len(rows) > MANY:
        rows = np.random.default_rng(0).choice(len(rows), MANY, replace=False)
    rows = rows[grid_subsample(pixels[rows], CELL)]
    if len(rows) < FEWEST:
        return
    pixels, disparity = np.asarray(pixels, np.float64)[rows], np.asarray(disparity)[rows]
    by_turn = _turn_errors(pixels, disparity, calibration)
    by_plane = _plane_errors(pixels, disparity)
    nearer = np.median(by_turn) < THAN_PLANE * np.median(by_plane)
    if nearer and np.mean(by_turn < BY_TURN) > MOSTLY:
        raise ReconstructionError(
            "a turn of the camera explains most disparities and there is no depth: move it "
            "sideways between the photographs"
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


def _turn_errors(pixels: np.ndarray, disparity: np.ndarray, calibration: Calibration) -> np.ndarray:
    """Fit a rotation to disparities robustly; (N,) what it leaves unexplained, in pixels.

    About the vertical and the line of sight: a tilt hardly changes disparities. Infinite when
    there is none that leaves the matches on their rows.
    """
    camera = calibration.camera1
    rays = calibration.camera0.rays(pixels)
    wanted = (pixels[:, 0] - disparity - camera.centre[0]) / camera.focal_px[0]
    # The turn about the vertical that most pixels ask for is near enough to begin with.
    angle = np.median(np.arctan(wanted) - np.arctan(rays[:, 0]))
    rotation = cv2.Rodrigues(np.array([0, angle, 0]))[0]
    error = np.empty(0)
    for step in range(STEPS + 1):
        turned = rays @ rotation.T
        if (turned[:, 2] <= 0).any():  # only with a focal length that cannot be
            return np.full(len(pixels), np.inf)
        x, y = (turned[:, :2] / turned[:, 2:]).T
        error = wanted - x
        if step < STEPS:
            slopes = np.column_stack([1 + x * x, -y])
            angles = _robust_step(slopes, error, camera.focal_px[0])
            rotation = cv2.Rodrigues(np.array([0, *angles]))[0] @ rotation
    off_row = y * camera.focal_px[1] + camera.centre[1] - pixels[:, 1]
    if np.median(np.abs(off_row)) > OFF_ROW:
        return np.full(len(pixels), np.inf)
    return np.abs(error) * camera.focal_px[0]


def _plane_errors(pixels: np.ndarray, disparity: np.ndarray) -> np.ndarray:
    """Fit disparities linear in x and y robustly; (N,) what they leave unexplained, in pixels."""
    design = np.column_stack([pixels / max(pixels.max(), 1), np.ones(len(pixels))])
    plane = np.array([0, 0, np.median(disparity)])
    for _ in range(STEPS):
        plane = plane + _robust_step(design, disparity - design @ plane, 1.0)
    return np.abs(disparity - design @ plane)


def _robust_step(design: np.ndarray, error: np.ndarray, pixel: float) -> np.ndarray:
    """Return the change of parameters that lessens the sum of absolute errors (reweighting)."""
    weight = 1 / np.sqrt(np.maximum(np.abs(error) * pixel, 0.02))
    return np.linalg.lstsq(design * weight[:, None], error * weight, rcond=None)[0]
