"""Two photographs in, coloured points in space out (paper, Figure 8).

    keypoints -> matches -> pose -> triangulation -> checks

A rectified pair has one road less: its matches lie along the rows, their disparity is the depth.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.errors import ReconstructionError
from .._shared.options import replace_options
from ..detector.detector import DeepDetect, HeatmapDetector, find_keypoints
from ..features.selection import SelectionOptions
from ..geometry.camera import Calibration, calibration_from_focal, read_calibration
from ..io.exif import calibration_from_exif
from ..io.image import load_image, luma
from ..matching.guided import InitialMatches, initial_matches
from ..matching.options import get_preset
from ..matching.pipeline import match_images
from .checks import check_images
from .outliers import statistical_inliers_on_grid
from .rectification import Rectification, judge_rectification
from .result import Reconstruction
from .row_degeneracy import (
    check_cameras,
    check_depths,
    check_disparities,
    check_keypoints,
    check_matched,
    check_turn,
)
from .stereo import COMPLETE, RowMatchingOptions, match_rows
from .two_view import TwoViewOptions, reconstruct_two_view


@dataclass(frozen=True, eq=False)
class ReconstructionOptions:
    """How a pair becomes points.

    Attributes:
        selection: which pixels become keypoints.
        rectified: whether matches lie on the same row of both images; None: found out.
        rows: how rectified pairs are matched; None: `COMPLETE` when every pixel is asked for
            (a density of 1), else the strict default.
        two_view: all stages of pairs that are not rectified.

    Raises:
        OptionError: a value is out of its range.
    """

    selection: SelectionOptions = field(default_factory=SelectionOptions)
    rectified: bool | None = None
    rows: RowMatchingOptions | None = None
    two_view: TwoViewOptions = field(default_factory=TwoViewOptions)

    @property
    def row_matching(self) -> RowMatchingOptions:
        """The options for rectified pairs that hold."""
        if self.rows is not None:
            return self.rows
        return COMPLETE if self.selection.density == 1 else RowMatchingOptions()


def reconstruct(
    left: Any,
    right: Any,
    detector: HeatmapDetector | None = None,
    *,
    calibration: Calibration | str | Path | None = None,
    focal_px: float | None = None,
    options: ReconstructionOptions | None = None,
    done: Callable[[str], object] = lambda stage: None,
    **changes: Any,
) -> Reconstruction:
    """Reconstruct a scene from two photographs.

    Args:
        left, right: anything `load_image` takes. For a pair that is not rectified "left" is only
            the first one, whose frame the points are in.
        detector: a `DeepDetect`, or anything with its `heatmap` method; default
            `DeepDetect("dense")`.
        calibration: a `Calibration` or the path of a calib.json (`calibration` tells its
            format); without one the focal length is taken from `focal_px`, or from EXIF.
        focal_px: focal length in pixels of both cameras, instead of a calibration.
        options: all options at once.
        done: called with the name of each stage when it is finished.
        **changes: single options by name, also those of `SelectionOptions`, `TwoViewOptions`
            and `SubpixelOptions`, as `density=1`, `rectified=True`, `neighbours=0`.

    Returns:
        The points, with everything that is known of them.

    Raises:
        ImageError: an image cannot be read or is not fit.
        OptionError: an option is unknown or out of its range.
        ReconstructionError: there is no calibration, it is wrong, or the pair gives no depth.

    Example:
        >>> from deepdetect.evaluation.controls import EveryPixel
        >>> rng = np.random.default_rng(0)
        >>> import cv2
        >>> scene = cv2.GaussianBlur(rng.integers(0, 256, (96, 200)).astype(np.uint8), (0, 0), 1)
        >>> x, y = np.meshgrid(np.arange(160, dtype=np.float32), np.arange(96, dtype=np.float32))
        >>> left = cv2.remap(scene, x + 10 + y / 16, y, cv2.INTER_CUBIC)
        >>> right = cv2.remap(scene, x + 20 + y / 8, y, cv2.INTER_CUBIC)
        >>> found = reconstruct(left, right, EveryPixel(), focal_px=300, rectified=True)
        >>> shift = 10 + found.pixels[:, 1] / 16
        >>> bool(np.median(np.abs(found.disparity - shift)) < 0.1), found.unit
        (True, 'baseline')
    """
    chosen = replace_options(options if options is not None else ReconstructionOptions(), **changes)
    seconds: dict[str, float] = {}
    images = load_image(left), load_image(right)
    sizes = tuple((image.shape[1], image.shape[0]) for image in images)
    known = _calibration(calibration, focal_px, (left, right), sizes)
    grays = luma(images[0]), luma(images[1])
    check_images(*grays)

    @contextmanager
    def stage(name: str) -> Iterator[None]:
        started = time.perf_counter()
        yield
        seconds[name] = time.perf_counter() - started
        done(name)

    initial = rectification = None
    rectified = chosen.rectified
    if rectified is None:
        with stage("rectified or not"):
            initial = initial_matches(*grays)
            rectification = judge_rectification(
                initial.points0,
                initial.points1,
                *sizes,
                offset_px=known.disparity_offset_px,
                seed=chosen.two_view.seed,
            )
        rectified = rectification.rectified
        if rectification.swapped:
            raise ReconstructionError(
                "this is a rectified pair with left and right exchanged: give the other one first"
                + _or_offset(known)
            )
    if detector is None:
        detector = DeepDetect("dense")
    make = _from_rows if rectified else _from_matches
    return make(
        _Pair(images, grays, detector, known, chosen, initial, rectification, seconds, stage)
    )


Images = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class _Pair:
    """What both roads begin with."""

    images: Images
    grays: Images
    detector: HeatmapDetector
    calibration: Calibration
    options: ReconstructionOptions
    initial: InitialMatches | None
    rectification: Rectification | None
    seconds: dict[str, float]
    stage: Callable[[str], Any]


def _from_rows(pair: _Pair) -> Reconstruction:
    """Reconstruct a rectified pair."""
    images, options, calibration = pair.images, pair.options, pair.calibration
    check_cameras(calibration)
    with pair.stage("keypoints"):
        # Disparities are those of pixels.
        selection = replace(options.selection, subpixel=False)
        keypoints = find_keypoints(pair.detector, images[0], selection)
    check_keypoints(len(keypoints), options.selection)
    with pair.stage("matching"):
        found = match_rows(*pair.grays, keypoints.xy, options.row_matching)
    row_options = options.row_matching
    sure = row_options.uniqueness > 1
    check_matched(np.count_nonzero(found.matched), len(keypoints), sure)
    check_disparities(found.disparity)
    pixels, disparity = keypoints.xy[found.rows], found.disparity
    check_turn(pixels[found.matched], disparity[found.matched], calibration)
    check_depths(disparity, calibration)
    size = (images[0].shape[1], images[0].shape[0])
    with pair.stage("triangulation"):
        depth = calibration.depth_mm(disparity)
        rays = calibration.camera0.rays(pixels)
    moved = disparity + calibration.disparity_offset_px
    in_front = moved > 0
    kept = in_front & (moved >= options.two_view.least_parallax_px)
    dropped = {
        "behind a camera": int(np.count_nonzero(~in_front)),
        "parallax": int(np.count_nonzero(in_front & ~kept)),
    }
    points = rays[kept] * depth[kept, None]
    if options.two_view.neighbours and row_options.edge_distance:
        with pair.stage("outlier removal"):
            inliers = statistical_inliers_on_grid(
                pixels[kept], disparity[kept], size, factor=options.two_view.factor
            )
        dropped["alone"] = int(np.count_nonzero(~inliers))
        kept[kept] = inliers
        points = points[inliers]
    if not len(points):
        raise ReconstructionError(
            "no disparity tells a depth: all are too small, the scene is too far away for cameras "
            "so close together"
        )
    pixels = pixels[kept]
    columns, rows = pixels.astype(np.int64).T
    return Reconstruction(
        points.astype(np.float32),
        images[0][rows, columns],
        pixels.astype(np.float32),
        disparity[kept],
        found.matched[kept],
        "baseline" if calibration.baseline_mm is None else "mm",
        size,
        True,
        pair.rectification,
        calibration,
        None,
        None,
        len(keypoints),
        len(found),
        dropped,
        pair.seconds,
    )


def _from_matches(pair: _Pair) -> Reconstruction:
    """Reconstruct a pair that is not rectified."""
    images, options, seconds = pair.images, pair.options, pair.seconds
    # Matches are refined from whole pixels of the left image. Suppression would leave few pixels
    # that are keypoints in both images.
    radius = options.selection.nms_radius or 0
    selection = replace(options.selection, subpixel=False, nms_radius=radius)
    with pair.stage("keypoints and matching"):
        found = match_images(
            *images,
            pair.detector,
            options=replace_options(
                get_preset("default"), selection=selection, matcher="patchmatch"
            ),
            # A homography would keep the points of one plane, and drop all that stands before it.
            guide="fundamental",
            model="none",
            seed=options.two_view.seed,
            initial=pair.initial,
        )
    with pair.stage("reconstruction"):
        made = reconstruct_two_view(
            found.points0, found.points1, pair.calibration, pair.grays, options.two_view
        )
    seconds.pop("reconstruction")
    seconds.update(made.seconds)
    pixels = found.points0[made.rows]
    columns, rows = np.rint(pixels).astype(np.int64).T
    return Reconstruction(
        made.points,
        images[0][rows, columns],
        pixels,
        None,
        np.ones(len(pixels), bool),
        made.unit,
        (images[0].shape[1], images[0].shape[0]),
        False,
        pair.rectification,
        pair.calibration,
        made.pose,
        made.reprojection_errors,
        len(found.keypoints0),
        len(found),
        made.dropped,
        seconds,
    )


def _or_offset(calibration: Calibration) -> str:
    """The other reason for disparities of the wrong sign, where there can be one."""
    offset = calibration.disparity_offset_px
    return f"; or the disparity offset of {offset:g} px is wrong" if offset else ""


def _calibration(
    given: Calibration | str | Path | None,
    focal_px: float | None,
    images: tuple[Any, Any],
    sizes: tuple[tuple[int, int], ...],
) -> Calibration:
    """Return the calibration that is given, or the one the photographs carry."""
    if given is not None and focal_px is not None:
        raise ReconstructionError("give a calibration or a focal length, not both")
    if isinstance(given, Calibration):
        given.check_sizes(*sizes)
        return given
    if given is not None:
        return read_calibration(given, *sizes)
    if focal_px is not None:
        return calibration_from_focal(focal_px, *sizes)
    return calibration_from_exif(*images, *sizes)
