"""Two images in, coloured 3D points out (paper, Figure 8).

General pairs: keypoints -> matches -> pose -> triangulation -> checks. Rectified pairs: a dense
disparity map, from which the keypoints of the left image take their points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.errors import ReconstructionError
from .._shared.image_array import Channels
from .._shared.options import suggest_keywords
from .._shared.timing import StageTimer
from ..detector.detector import AnyDetector, DeepDetect, find_keypoints
from ..detector.image_lists import Images, ignore_masks
from ..features.selection import SelectionOptions
from ..geometry.camera import Calibration, calibration_from_focal, read_calibration
from ..io.exif import calibration_from_exif
from ..matching.guided import TentativeMatches
from ..matching.options import MatchingOptions
from ..matching.pipeline import LoadedPair, match_pair
from ..matching.stereo.matching import DENSE, DisparityOptions, compute_disparity
from .checks import check_images
from .outliers import PointFilterOptions, sor_inliers_on_grid
from .rectification import Rectification, find_rectification
from .rectified_checks import (
    check_cameras,
    check_depths,
    check_disparities,
    check_keypoints,
    check_matched,
    check_pure_rotation,
)
from .result import Reconstruction
from .two_view import reconstruct_two_view


@suggest_keywords
@dataclass(frozen=True, eq=False)
class ReconstructionOptions:
    """How a pair becomes points.

    Attributes:
        disparity: the disparity map of rectified pairs; None: `DENSE` for a density of 1, else the
            strict default.
        point_filter: which points are kept.
    """

    disparity: DisparityOptions | None = None
    point_filter: PointFilterOptions = field(default_factory=PointFilterOptions)


@suggest_keywords
def reconstruct(
    left: Any,
    right: Any,
    detector: AnyDetector | None = None,
    *,
    channels: Channels = "rgb",
    calibration: Calibration | str | Path | None = None,
    focal_px: float | None = None,
    rectified: bool | None = None,
    selection: SelectionOptions | None = None,
    ignore: np.ndarray | Images | None = None,
    seed: int = 0,
    options: ReconstructionOptions = ReconstructionOptions(),
    progress: Callable[[str], object] | None = None,
) -> Reconstruction:
    """Reconstruct a scene from two images.

    For a rectified pair the detector only chooses which pixels of a dense disparity map become
    points; `disparity_map` gives that map without a detector.

    Args:
        left, right: anything `load_image` takes. For a pair that is not rectified "left" is only
            the first one, whose frame the points are in.
        detector: as of `match_images`; default `DeepDetect("dense")`.
        channels: order of the colours in images that are arrays, as of `load_image`.
        calibration: JSON file of the cameras (docs/reconstruction.md describes its format), or a
            `Calibration`. Without one the focal length is taken from `focal_px`, or from EXIF.
        focal_px: focal length in pixels of both cameras, instead of a calibration.
        rectified: whether matches lie on the same row of both images. None: detected.
        selection: which pixels of a heat map become keypoints; None: those over 0.5. A density of 1
            takes every pixel, and `DENSE` disparities; `subpixel` does not apply.
        ignore: as of `match_images`; of a rectified pair only the mask of the left image counts.
        seed: of all random choices.
        options: all else.
        progress: called with the name of each stage when it ends.

    Returns:
        The points, with all that is known about them.

    Raises:
        ImageError: an image cannot be read or is not fit.
        OptionError: an option is unknown or out of its range.
        MissingExtraError: numba is not installed.
        ReconstructionError: there is no calibration, it is wrong, or the pair gives no depth.

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
    loaded = LoadedPair.load(left, right, channels)
    images, grays = loaded.rgb, loaded.gray
    sizes = (images[0].shape[1], images[0].shape[0]), (images[1].shape[1], images[1].shape[0])
    known = _calibration(calibration, focal_px, (left, right), sizes)
    check_images(*grays)
    timer = StageTimer(progress)
    tentative = rectification = None
    is_rectified = rectified
    if is_rectified is None:
        with timer.stage("rectified or not"):
            rectification, tentative = find_rectification(*grays, known.disparity_offset_px, seed)
        is_rectified = rectification.rectified
        if rectification.swapped:
            offset = known.disparity_offset_px
            raise ReconstructionError(
                "this is a rectified pair with left and right exchanged: give the other one first"
                + (f"; or the disparity offset of {offset:g} px is wrong" if offset else "")
            )
    if detector is None:
        detector = DeepDetect("dense")
    masks = ignore_masks(ignore, 2)
    pair = _Pair(
        loaded, detector, selection, masks, known, seed, options, tentative, rectification, timer
    )
    return _reconstruct_rectified(pair) if is_rectified else _reconstruct_general(pair)


Size = tuple[int, int]


@dataclass(frozen=True, eq=False)
class _Pair:
    """What both pipelines begin with."""

    loaded: LoadedPair
    detector: AnyDetector
    selection: SelectionOptions | None
    masks: list[np.ndarray | None]
    calibration: Calibration
    seed: int
    options: ReconstructionOptions
    tentative: TentativeMatches | None
    rectification: Rectification | None
    timer: StageTimer


def _reconstruct_rectified(pair: _Pair) -> Reconstruction:
    """Take the keypoints of the left image from the disparity map of the pair."""
    image, options = pair.loaded.rgb[0], pair.options
    calibration, timer = pair.calibration, pair.timer
    disparity_options = options.disparity
    if disparity_options is None:
        every_pixel = pair.selection is not None and pair.selection.density == 1
        disparity_options = DENSE if every_pixel else DisparityOptions()
    check_cameras(calibration)
    with timer.stage("keypoints"):
        keypoints = find_keypoints(pair.detector, image, _whole_pixels(pair), pair.masks[0])
        # Disparities are those of pixels.
        keypoints = replace(keypoints, xy=np.rint(keypoints.xy))
    check_keypoints(len(keypoints), pair.selection or SelectionOptions())
    with timer.stage("matching"):
        found = compute_disparity(*pair.loaded.gray, disparity_options).at(keypoints)
    matched = found.matched
    unique = disparity_options.uniqueness_ratio > 1
    check_matched(int(np.count_nonzero(matched)), len(keypoints), unique)
    check_disparities(found.disparity)
    pixels, disparity = keypoints.xy[found.indices], found.disparity
    check_pure_rotation(pixels[matched], disparity[matched], calibration)
    check_depths(disparity, calibration)
    size = (image.shape[1], image.shape[0])
    with timer.stage("triangulation"):
        depth = calibration.depth_mm(disparity)
        rays = calibration.camera0.rays(pixels)
    shift = disparity + calibration.disparity_offset_px
    in_front = shift > 0
    kept = in_front & (shift >= options.point_filter.min_parallax_px)
    dropped = {
        "behind a camera": int(np.count_nonzero(~in_front)),
        "parallax": int(np.count_nonzero(in_front & ~kept)),
    }
    points = rays[kept] * depth[kept, None]
    if options.point_filter.sor_neighbors and disparity_options.discontinuity_margin_px:
        with timer.stage("outlier removal"):
            inliers = sor_inliers_on_grid(
                pixels[kept],
                disparity[kept],
                size,
                options.point_filter.sor_window_px,
                options.point_filter.sor_std_ratio,
            )
        dropped["statistical outlier"] = int(np.count_nonzero(~inliers))
        kept[kept] = inliers
        points = points[inliers]
    if not len(points):
        raise ReconstructionError(
            "no disparity gives a depth: all are too small, the scene is too far away for cameras "
            "so close together"
        )
    pixels = pixels[kept]
    columns, rows = pixels.astype(np.int64).T
    return Reconstruction(
        points=points.astype(np.float32),
        colors=image[rows, columns],
        pixels=pixels.astype(np.float32),
        disparity=disparity[kept],
        matched=matched[kept],
        unit="baseline" if calibration.baseline_mm is None else "mm",
        size=size,
        rectified=True,
        rectification=pair.rectification,
        calibration=calibration,
        pose=None,
        reprojection_errors=None,
        keypoints=len(keypoints),
        matches=len(found),
        dropped=dropped,
        seconds=timer.seconds,
    )


def _reconstruct_general(pair: _Pair) -> Reconstruction:
    """Match the keypoints of both images, estimate the pose and triangulate."""
    image, options, timer = pair.loaded.rgb[0], pair.options, pair.timer
    with timer.stage("keypoints and matching"):
        found = match_pair(
            pair.loaded,
            pair.detector,
            selection=_whole_pixels(pair),
            ignore=pair.masks,
            # A homography would keep the points of one plane, and drop all in front of it.
            model="none",
            options=MatchingOptions(two_view_model="fundamental"),
            seed=pair.seed,
            tentative_matches=pair.tentative,
        )
    made = reconstruct_two_view(
        found.points0,
        found.points1,
        pair.calibration,
        pair.loaded.gray,
        options.point_filter,
        pair.seed,
        timer,
        refined=found.subpixel,
    )
    pixels = found.points0[made.indices]
    columns, rows = np.rint(pixels).astype(np.int64).T
    return Reconstruction(
        points=made.points,
        colors=image[rows, columns],
        pixels=pixels,
        disparity=None,
        matched=np.ones(len(pixels), bool),
        unit=made.unit,
        size=(image.shape[1], image.shape[0]),
        rectified=False,
        rectification=pair.rectification,
        calibration=pair.calibration,
        pose=made.pose,
        reprojection_errors=made.reprojection_errors,
        keypoints=len(found.keypoints0),
        matches=len(found),
        dropped=made.dropped,
        seconds=timer.seconds,
    )


def _whole_pixels(pair: _Pair) -> SelectionOptions | None:
    """Return the selection without refined positions: matches start at whole pixels."""
    return None if pair.selection is None else replace(pair.selection, subpixel=False)


def _calibration(
    given: Calibration | str | Path | None,
    focal_px: float | None,
    images: tuple[Any, Any],
    sizes: tuple[Size, Size],
) -> Calibration:
    """Return the calibration that is given, or the one the images carry."""
    if given is not None and focal_px is not None:
        raise ReconstructionError("give `calibration` or `focal_px`, not both")
    if isinstance(given, Calibration):
        given.check_sizes(*sizes)
        return given
    if given is not None:
        return read_calibration(given, *sizes)
    if focal_px is not None:
        return calibration_from_focal(focal_px, *sizes)
    return calibration_from_exif(*images, *sizes)
