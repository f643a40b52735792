"""Points whose counterpart lies outside the right image: how many there are, and how many right.

Without an offset these lie at the left border of the left image. Cropping the views makes pairs
with a disparity offset, as rectification does: then more of them do, or those at the right border.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ...datasets.types import CalibratedStereoPair
from ...geometry.camera import Calibration, Camera
from ..metrics.stereo import (
    DISPARITY_TOLERANCES_PX,
    TOLERANCE_PX,
    disparity_accuracy,
    outside_accuracy,
)
from ..report import Cell, Column, Table
from .stereo_pipelines import StereoPoints

CROPPED_PX = (-40, 40)
"""Offsets of the disparity that the cropped pairs have."""

COLUMNS = (
    Column("pipeline"),
    Column("offset, px", "d"),
    Column("pixels outside", ",d"),
    Column("with a point", ",d"),
    Column("of these within 1 px", ".4f"),
    Column("1 - bad-1 of all", ".4f"),
    Column("completeness at 1 px of all", ".4f"),
)

NOTE = (
    "Pixels whose true counterpart lies outside the right image: no method can see it there. "
    "Offset: of the disparity, given by cropping one view at its left end and the other at its "
    "right end; the calibration is cropped with them."
)


def crop_pair(pair: CalibratedStereoPair, offset_px: int) -> CalibratedStereoPair:
    """Crop both views, so that all disparities grow by an offset.

    For a positive offset the left end of the right view and the right end of the left view go, for
    a negative one the others. The depths stay as they are.

    Args:
        pair: the pair.
        offset_px: columns.
    """
    width = pair.left.shape[1]
    kept = width - abs(offset_px)
    starts = max(-offset_px, 0), max(offset_px, 0)
    left, right = (
        np.ascontiguousarray(view[:, start : start + kept])
        for view, start in zip((pair.left, pair.right), starts, strict=True)
    )
    disparity = pair.disparity[:, starts[0] : starts[0] + kept] + np.float32(offset_px)
    cameras = pair.calibration.camera0, pair.calibration.camera1
    camera0, camera1 = (
        Camera(
            (kept, camera.size[1]), camera.focal_px, (camera.centre[0] - start, camera.centre[1])
        )
        for camera, start in zip(cameras, starts, strict=True)
    )
    calibration = Calibration(
        camera0, camera1, pair.calibration.baseline_mm, pair.calibration.source
    )
    return CalibratedStereoPair(pair.name, left, right, disparity, calibration)


def crop_truth(disparity: np.ndarray, offset_px: int) -> np.ndarray:
    """Return the true disparity of a pair that `crop_pair` has cropped.

    Example:
        >>> crop_truth(np.array([[5.0, 6.0, 7.0]]), -1)
        array([[5., 6.]])
        >>> crop_truth(np.array([[5.0, 6.0, 7.0]]), 1)
        array([[6., 7.]])
    """
    kept = disparity.shape[1] - abs(offset_px)
    start = max(-offset_px, 0)
    return disparity[:, start : start + kept] + offset_px


def outside_table(
    scene: str,
    title: str,
    truth: np.ndarray,
    found: Mapping[tuple[str, int], StereoPoints],
    pipelines: Sequence[str],
) -> Table:
    """Evaluate the points that the right image cannot show.

    Args:
        scene: its name, which names the table's file.
        title: the line above the table.
        truth: (H, W) true disparity of the pair that is not cropped, NaN where it is unknown.
        found: points by pipeline and offset.
        pipelines: the rows, one for each offset.
    """
    rows: list[tuple[Cell, ...]] = []
    for offset in (0, *CROPPED_PX):
        true = crop_truth(truth, offset)
        for pipeline in pipelines:
            points = found.get((pipeline, offset))
            if points is None:
                rows.append((pipeline, offset, *(None,) * (len(COLUMNS) - 2)))
                continue
            outside = outside_accuracy(points.pixels, points.disparity, true)
            whole = disparity_accuracy(points.pixels, points.disparity, true)
            rows.append(
                (
                    pipeline,
                    offset,
                    outside.outside,
                    outside.given,
                    outside.accuracy,
                    whole.accuracy[DISPARITY_TOLERANCES_PX.index(TOLERANCE_PX)],
                    whole.completeness,
                )
            )
    return Table(f"middlebury_outside_{scene}", title, COLUMNS, tuple(rows), NOTE)
