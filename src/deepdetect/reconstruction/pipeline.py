"""Reconstruct coloured 3D points from two images, as in Figure 8 of the DeepDetect paper.

For a pair that is not rectified, the steps are keypoints, matches, checks, pose and triangulation.
For a rectified pair, a dense disparity map is computed, and its values at the keypoints of the left
image give the points.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.errors import NoDepthError, OptionError, ReconstructionError
from .._shared.image_array import Channels
from .._shared.options import suggest_keywords
from .._shared.progress import StageTimer
from ..detector.detector import AnyDetector, DeepDetect, find_keypoints
from ..features.keypoints import Keypoints
from ..features.selection import SelectionOptions
from ..geometry.camera import Calibration, Camera
from ..geometry.estimation import GeometryOptions, check_model
from ..geometry.images import window_sums
from ..geometry.relative_pose import RelativePose
from ..io.exif import calibration_from_exif
from ..io.image import Images, load_pair, luma
from ..io.projection import require_pinhole
from ..matching.overlay import scene_of
from ..matching.pipeline import match_images
from ..matching.stereo.matching import DENSE, DisparityOptions, compute_disparity
from .outliers import PointFilterOptions
from .rectification import (
    check_cameras,
    check_depths,
    check_disparities,
    check_pure_rotation,
    find_rectification,
)
from .result import Reconstruction
from .two_view import checked_pose, reconstruct_two_view, refined_corners, scene_with_depth

SOR_WINDOW_PX = 9
"""Statistical outlier removal (SOR) compares a pixel of a rectified pair with all other pixels in a
window with this side. Chosen by hand."""

MIN_UNIQUE_FRACTION, MIN_MATCHED_FRACTION = 0.1, 0.25
"""Minimum fraction of keypoints that find a match on their row. If matches must be unique, it is
MIN_UNIQUE_FRACTION: in trials, unrelated photographs had up to 0.005, rectified pairs 0.35 or more.
Otherwise it is MIN_MATCHED_FRACTION: unrelated ones had up to 0.16, rectified ones 0.64 or more."""


@suggest_keywords
def reconstruct(
    image0: Any,
    image1: Any,
    detector: AnyDetector | None = None,
    *,
    channels: Channels = "rgb",
    calibration: Calibration | str | Path | None = None,
    focal_px: float | None = None,
    rectified: bool | None = None,
    selection: SelectionOptions | None = None,
    ignore: np.ndarray | Images | None = None,
    seed: int = 0,
    point_filter: PointFilterOptions = PointFilterOptions(),
    progress: Callable[[str], object] | None = None,
) -> Reconstruction:
    """Reconstruct a scene from two images.

    For a rectified pair, a dense disparity map is computed, and the detector only chooses which
    pixels become points. `disparity_map` computes this map without a detector.

    Args:
        image0, image1: anything `load_image` takes. The points are in the frame of the first
            camera, which is the left one of a rectified pair.
        detector: a detector as in `match_images`; default `DeepDetect("dense")`.
        channels: order of the colours in images that are arrays, as in `load_image`.
        calibration: camera file, such as calib.json. A `Calibration` also works. By default the
            focal length is `focal_px`, or is read from the EXIF data of the images.
        focal_px: focal length in pixels of both cameras, instead of a calibration.
        rectified: whether matches lie on the same row of both images. None: the images decide.
        selection: which pixels of a heat map become keypoints; None takes those with a probability
            above 0.5. With a density of 1, every pixel of a rectified pair becomes a point, with
            the disparity options `DENSE`. `subpixel` is ignored.
        ignore: masks as in `match_images`. A rectified pair only uses the mask of the left image.
        seed: seed of all random choices.
        point_filter: which points are kept.
        progress: called with the name of each stage when it ends.

    Returns:
        The points, and how they were found.

    Raises:
        ImageError: an image cannot be read or used.
        OptionError: an option is unknown or out of its range.
        ReconstructionError: the calibration is missing or wrong, or the pair gives no depth.

    Example:
        >>> import cv2
        >>> rng = np.random.default_rng(0)
        >>> scene = cv2.GaussianBlur(rng.integers(0, 256, (96, 200)).astype(np.uint8), (0, 0), 1)
        >>> x, y = np.meshgrid(np.arange(160, dtype=np.float32), np.arange(96, dtype=np.float32))
        >>> left = cv2.remap(scene, x + 10 + y / 16, y, cv2.INTER_CUBIC)
        >>> right = cv2.remap(scene, x + 20 + y / 8, y, cv2.INTER_CUBIC)
        >>> found = reconstruct(left, right, focal_px=300, rectified=True,
        ...     selection=SelectionOptions(density=1))
        >>> shift = 10 + found.pixels[:, 1] / 16
        >>> bool(np.median(np.abs(found.disparity - shift)) < 0.1), found.unit
        (True, 'baseline')
    """
    check_model("fundamental", seed, GeometryOptions())
    images = image0, image1
    rgb, masks, _, known = _load_pair(images, channels, calibration, focal_px, ignore)
    pair, left_out = scene_of(rgb, masks, seed)
    grays, masks = pair.grays, pair.masks
    timer = StageTimer(progress)
    rectification = None
    if rectified is None:
        with timer.stage("rectified or not"):
            rectification = find_rectification(*grays, known.disparity_offset_px, seed)
        rectified = rectification.rectified
        if rectification.swapped:
            offset = known.disparity_offset_px
            raise ReconstructionError(
                "left and right of this rectified pair are exchanged: give the other image first"
                + (f"; or the disparity offset of {offset:g} px is wrong" if offset else "")
            )
    detector = DeepDetect("dense") if detector is None else detector
    # Matches and disparities are computed at whole pixels of the left image.
    whole = None if selection is None else replace(selection, subpixel=False)
    if rectified:
        with timer.stage("keypoints"):
            keypoints = find_keypoints(detector, rgb[0], whole, masks[0])
        every_pixel = selection is not None and selection.density == 1
        disparity = DENSE if every_pixel else DisparityOptions()
        made = _from_disparities(keypoints, grays, known, disparity, point_filter, timer)
    else:
        with timer.stage("keypoints and matching"):
            matches = match_images(
                rgb[0],
                rgb[1],
                detector,
                selection=whole,
                ignore=tuple(masks),
                seed=seed,
            )
        made = reconstruct_two_view(matches, grays, known, point_filter, seed, timer)
    columns, rows = np.rint(made["pixels"]).astype(np.int64).T
    return Reconstruction(
        **made,
        colors=rgb[0][rows, columns],
        unit="baseline" if known.baseline_mm is None else "mm",
        size=grays[0].shape[::-1],
        rectified=rectified,
        rectification=rectification,
        calibration=known,
        seconds=timer.seconds,
        left_out=left_out,
    )


@suggest_keywords
def estimate_pose(
    image0: Any,
    image1: Any,
    detector: AnyDetector | None = None,
    *,
    channels: Channels = "rgb",
    calibration: Calibration | str | Path | None = None,
    focal_px: float | None = None,
    seed: int = 0,
    progress: Callable[[str], object] | None = None,
) -> RelativePose:
    """Estimate the pose of the second camera in the frame of the first, from their images.

    Args:
        image0, image1: anything `load_image` takes.
        detector: a detector as in `match_images`; default `DeepDetect()`.
        channels: order of the colours in images that are arrays, as in `load_image`.
        calibration: camera file, such as calib.json. A `Calibration` also works. By default the
            focal length is `focal_px`, or is read from the EXIF data of the images.
        focal_px: focal length in pixels of both cameras, instead of a calibration.
        seed: seed of all random choices.
        progress: called with the name of each stage when it ends.

    Returns:
        Rotation and translation: X1 = rotation @ X0 + translation. The translation has length 1,
        because its true length is unknown.

    Raises:
        ImageError: an image cannot be read or used.
        ReconstructionError: the calibration is missing or wrong.
        NoDepthError: the images do not overlap or show one plane, or the camera did not move or
            only rotated, so the matches do not determine the pose.

    Example:
        >>> import cv2
        >>> rng = np.random.default_rng(0)
        >>> scene = cv2.GaussianBlur(rng.integers(0, 256, (240, 360)).astype(np.uint8), (0, 0), 1)
        >>> x, y = np.meshgrid(np.arange(320, dtype=np.float32), np.arange(240, dtype=np.float32))
        >>> relief = np.float32(6 * np.sin(x / 40) * np.cos(y / 30))
        >>> second = cv2.remap(scene, x + 20 + relief, y, cv2.INTER_CUBIC)
        >>> pose = estimate_pose(scene[:, :320], second, focal_px=300)
        >>> bool(pose.angle < 2), bool(pose.translation[0] < -0.9)
        (True, True)
    """
    check_model("fundamental", seed, GeometryOptions())
    images = image0, image1
    rgb, masks, grays, known = _load_pair(images, channels, calibration, focal_px)
    timer = StageTimer(progress)
    with timer.stage("keypoints and matching"):
        matches = match_images(
            rgb[0],
            rgb[1],
            detector,
            ignore=masks,
            seed=seed,
        )
    scene, fundamental = scene_with_depth(matches)
    with timer.stage("sub-pixel"):
        corners = refined_corners(grays, scene.points0, scene.points1)
    pose = checked_pose(*corners, fundamental, known, seed, timer)
    left_out = 0.0 if matches.geometry is None else matches.geometry.evidence.left_out
    return replace(pose, left_out=left_out)


def _from_disparities(
    keypoints: Keypoints,
    grays: tuple[np.ndarray, np.ndarray],
    calibration: Calibration,
    options: DisparityOptions,
    point_filter: PointFilterOptions,
    timer: StageTimer,
) -> dict[str, Any]:
    """Compute points at the left keypoints of a rectified pair; return `Reconstruction` fields."""
    check_cameras(calibration)
    keypoints = replace(keypoints, xy=np.rint(keypoints.xy))
    if not len(keypoints):
        raise NoDepthError(
            "the left image has no keypoints: lower `threshold`, or give a larger `density`"
        )
    with timer.stage("matching"):
        found = compute_disparity(*grays, options).at(keypoints)
    matched, disparity = found.matched, found.disparity
    least = MIN_UNIQUE_FRACTION if options.uniqueness_ratio > 1 else MIN_MATCHED_FRACTION
    if np.count_nonzero(matched) < least * len(keypoints):
        raise NoDepthError(
            f"only {np.count_nonzero(matched):,} of {len(keypoints):,} keypoints have a match on "
            "their row: the images hardly overlap, show different scenes, or are not rectified"
        )
    check_disparities(disparity)
    pixels = keypoints.xy[found.indices]
    check_pure_rotation(pixels[matched], disparity[matched], calibration)
    check_depths(disparity, calibration)
    with timer.stage("triangulation"):
        rays, depth = calibration.camera0.rays(pixels), calibration.depth_mm(disparity)
    shift = disparity + calibration.disparity_offset_px
    in_front = shift > 0
    kept = in_front & (shift >= point_filter.min_parallax_px)
    dropped = {
        "behind a camera": int(np.count_nonzero(~in_front)),
        "parallax": int(np.count_nonzero(in_front & ~kept)),
    }
    if point_filter.sor_neighbors and options.discontinuity_margin_px:
        with timer.stage("outlier removal"):
            inliers = sor_inliers_on_grid(
                pixels[kept], disparity[kept], grays[0].shape[::-1], point_filter
            )
        dropped["statistical outlier"] = int(np.count_nonzero(~inliers))
        kept[kept] = inliers
    if not kept.any():
        raise ReconstructionError(
            "no disparity gives a depth: the scene is too far away for this baseline"
        )
    return {
        "points": (rays[kept] * depth[kept, None]).astype(np.float32),
        "pixels": pixels[kept].astype(np.float32),
        "disparity": disparity[kept],
        "matched": matched[kept],
        "pose": None,
        "reprojection_errors": None,
        "keypoints": len(keypoints),
        "matches": len(found),
        "dropped": dropped,
    }


def sor_inliers_on_grid(
    pixels: np.ndarray,
    disparity: np.ndarray,
    size: tuple[int, int],
    point_filter: PointFilterOptions = PointFilterOptions(),
) -> np.ndarray:
    """Return (N,) bool, True for (N, 2) pixels of the left image that are not statistical outliers.

    Unlike in `sor_inliers`, the neighbours of a pixel are all other pixels in a window. A pixel's
    distance from its neighbours is the root mean square difference in disparity. A pixel without
    neighbours is an outlier only if most pixels have neighbours.
    """
    if not len(pixels):
        return np.ones(0, bool)
    places = np.rint(pixels).astype(np.int64)
    middle = float(np.median(disparity))  # subtracted: large squares would lose small differences
    centred = (disparity - middle).astype(np.float64)
    others, total, squares = (
        window_sums(places, values, size[::-1], SOR_WINDOW_PX)
        for values in (1.0, centred, centred**2)
    )
    others = others - 1
    differences = squares - 2 * centred * total + (others + 1) * centred**2
    distances = np.sqrt(np.maximum(differences, 0) / np.maximum(others, 1))
    accompanied = others > 0.5
    if not accompanied.any():
        return np.ones(len(pixels), bool)
    near = distances[accompanied]
    isolated = ~accompanied & (accompanied.mean() > 0.5)
    return (distances <= near.mean() + point_filter.sor_std_ratio * near.std() + 1e-6) & ~isolated


def _load_pair(
    images: tuple[Any, Any],
    channels: Channels,
    calibration: Calibration | str | Path | None,
    focal_px: float | None,
    ignore: Any = None,
) -> tuple[Any, Any, tuple[np.ndarray, np.ndarray], Calibration]:
    """Load two images; return them as RGB, their masks, both as luma, and their calibration."""
    rgb, masks = load_pair(images, channels, ignore)
    for number, image in enumerate(images):
        require_pinhole(image, rgb[number], name=f"images[{number}]")
    grays = luma(rgb[0]), luma(rgb[1])
    sizes = grays[0].shape[::-1], grays[1].shape[::-1]
    return rgb, masks, grays, _calibration(calibration, focal_px, images, sizes)


def _calibration(
    given: Calibration | str | Path | None,
    focal_px: float | None,
    images: tuple[Any, Any],
    sizes: tuple[tuple[int, int], tuple[int, int]],
) -> Calibration:
    if given is not None and focal_px is not None:
        raise OptionError("give `calibration` or `focal_px`, not both")
    if isinstance(given, Calibration):
        given.check_sizes(*sizes)
        return given
    if given is not None:
        names = [str(image) if isinstance(image, (str, Path)) else "" for image in images]
        left, right = (re.search(r"image_0?(\d)\b", name) for name in names)  # KITTI's cameras
        views = (int(left[1]), int(right[1])) if left and right else None
        return Calibration.load(given, *sizes, views=views)
    if focal_px is not None:
        camera0, camera1 = (Camera(size, focal_px) for size in sizes)
        return Calibration(camera0, camera1, source="focal_px")
    return calibration_from_exif(*images, *sizes)
