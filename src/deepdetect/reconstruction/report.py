"""Counts, times and quality of a reconstruction, as plain values for JSON."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from ..geometry.camera import Calibration, Camera
from .result import Reconstruction

PERCENTILES = (0, 5, 25, 50, 75, 95, 100)

SCALE = {
    "mm": "lengths are in mm",
    "baseline": "lengths are in baselines: the true scale is not known (give baseline_mm in a "
    "calib.json)",
}


def reconstruction_values(found: Reconstruction) -> dict[str, Any]:
    """Return all but the arrays of a reconstruction; NaN becomes None.

    Args:
        found: of `reconstruct`.
    """
    depth = np.percentile(found.points[:, 2].astype(np.float64), PERCENTILES)
    errors, disparity = found.reprojection_errors, found.disparity
    return {
        "points": len(found),
        "filled": int(np.count_nonzero(~found.matched)),
        "keypoints": found.keypoints,
        "matches": found.matches,
        "dropped": dict(found.dropped),
        "width": found.size[0],
        "height": found.size[1],
        "density": round(len(found) / (found.size[0] * found.size[1]), 6),
        "rectified": found.rectified,
        "rectified_why": _why(found),
        "rectification": _rectification(found),
        "unit": found.unit,
        "scale": SCALE[found.unit],
        "depth": _percentiles(depth),
        "disparity": None
        if disparity is None
        else _percentiles(np.percentile(disparity.astype(np.float64), PERCENTILES)),
        "median_parallax_degrees": round(float(np.median(found.parallax())), 4),
        "median_reprojection_error_px": None
        if errors is None
        else round(float(np.median(errors)), 4),
        "pose": _pose(found),
        "calibration": _calibration(found.calibration),
        "seconds": {stage: round(value, 4) for stage, value in found.seconds.items()},
    }


def _why(found: Reconstruction) -> str:
    judged = found.rectification
    if judged is None:
        return "as asked for"
    if judged.rectified:
        return f"{judged.on_rows:,} of {judged.matches:,} sparse matches are on the same row"
    return judged.reason


def _rectification(found: Reconstruction) -> dict[str, Any] | None:
    if found.rectification is None:
        return None
    return {name: _finite(value) for name, value in dataclasses.asdict(found.rectification).items()}


def _pose(found: Reconstruction) -> dict[str, Any] | None:
    """Return where the right camera is, for pairs that are not rectified."""
    if found.pose is None:
        return None
    return {
        "rotation": found.pose.rotation.tolist(),
        "translation": found.pose.translation.tolist(),
        "angle_degrees": round(found.pose.angle, 4),
        "in_front": round(found.pose.cheirality_ratio, 4),
    }


def _calibration(calibration: Calibration) -> dict[str, Any]:
    return {
        "source": calibration.source,
        "baseline_mm": calibration.baseline_mm,
        "disparity_offset_px": round(calibration.disparity_offset_px, 6),
        "left": _camera(calibration.camera0),
        "right": _camera(calibration.camera1),
    }


def _camera(camera: Camera) -> dict[str, Any]:
    return {
        "width": camera.size[0],
        "height": camera.size[1],
        "focal_px": list(camera.focal_px),
        "cx": camera.centre[0],
        "cy": camera.centre[1],
    }


def _percentiles(values: np.ndarray) -> dict[str, float]:
    return {
        f"{percent}%": float(f"{value:.6g}")
        for percent, value in zip(PERCENTILES, values, strict=True)
    }


def _finite(value: Any) -> Any:
    if isinstance(value, (tuple, list)):
        return [_finite(part) for part in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
