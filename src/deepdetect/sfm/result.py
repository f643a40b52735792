"""The result of a reconstruction of many images: cameras, points, and statistics."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..geometry.camera import PosedView
from ..geometry.point_cloud import PointCloud
from .colmap import CameraIntrinsics
from .georeference import Georeference

SCALE = "lengths are in units of the median distance from a camera to its nearest neighbour: the \
true scale is unknown because"


@dataclass(frozen=True, eq=False, repr=False)
class MultiViewReconstruction:
    """Cameras and points of many images.

    The world frame is that of the camera of the image `reference`: x right, y down, z forward. The
    unit is the median distance from a camera to its nearest neighbour, or a metre if `scale_by`
    gave a length. If GPS or ground control points place the model, its axes point east, north and
    up instead, in metres.

    Attributes:
        views: poses of the registered images, by name, with pinhole cameras.
        intrinsics: intrinsics of the same cameras, with their distortion.
        unregistered: reasons why the other images are not registered, by name.
        components: groups of unregistered images that are connected with each other, as tuples of
            names, the largest group first. Each group can be reconstructed by itself.
        reference: name of the image that sees the most points.
        georeference: scale and place of the model, or a sentence on why they are unknown.
        sparse: points from which the poses were estimated.
        sparse_errors: (N,) float32 mean reprojection errors of these points in pixels.
        sparse_views: (N,) int32 number of images that see each of these points.
        dense: dense points; empty if the options asked for none.
        dense_errors: (M,) float32 errors of the dense points: root mean square distance, in pixels,
            between a point's projections to other images and its matches there.
        dense_views: (M,) uint8 number of images that agree on each dense point.
        keypoints: number of keypoints, by image.
        matched: number of verified matches, by pair.
        pairs: number of pairs that were matched.
        pair_choice: how the pairs were chosen, such as "exhaustive", "sequential:10" or "similar".
        left_out: largest fraction of an image that was ignored as a static overlay, such as a logo.
        seconds: time of each stage in this run, about 0 if an earlier run finished the stage.
        files: files and folders that were written.
    """

    views: Mapping[str, PosedView]
    intrinsics: Mapping[str, CameraIntrinsics]
    unregistered: Mapping[str, str]
    components: tuple[tuple[str, ...], ...]
    reference: str
    georeference: Georeference | str
    sparse: PointCloud
    sparse_errors: np.ndarray
    sparse_views: np.ndarray
    dense: PointCloud
    dense_errors: np.ndarray
    dense_views: np.ndarray
    keypoints: Mapping[str, int]
    matched: Mapping[tuple[str, str], int]
    pairs: int
    pair_choice: str
    left_out: float
    seconds: Mapping[str, float]
    files: tuple[Path, ...]

    def __repr__(self) -> str:
        total = len(self.views) + len(self.unregistered)
        return (
            f"MultiViewReconstruction({len(self.views)} of {total} images, "
            f"{len(self.sparse):,} sparse and {len(self.dense):,} dense points)"
        )

    @property
    def cloud(self) -> PointCloud:
        """The dense points, or the sparse ones if there are no dense points."""
        return self.dense if len(self.dense) else self.sparse

    @property
    def centres(self) -> np.ndarray:
        """(V, 3) float64 centres of the cameras, in the order of `views`."""
        return np.array([view.centre for view in self.views.values()]).reshape(-1, 3)

    def summary(self) -> dict[str, Any]:
        """Return everything except the arrays of points, as plain Python types for JSON."""
        by_views = Counter(self.dense_views.tolist())
        return {
            "images": len(self.views) + len(self.unregistered),
            "registered": len(self.views),
            "unregistered": dict(self.unregistered),
            "components": [list(names) for names in self.components],
            "reference": self.reference,
            **_place(self.georeference),
            "keypoints": sum(self.keypoints.values()),
            "pairs": self.pairs,
            "pair_choice": self.pair_choice,
            "left_out": round(self.left_out, 4),
            "verified_pairs": len(self.matched),
            "verified_matches": sum(self.matched.values()),
            "sparse_points": len(self.sparse),
            "mean_track_length": _rounded(self.sparse_views, np.mean),
            "mean_sparse_reprojection_error_px": _rounded(self.sparse_errors, np.mean),
            "dense_points": len(self.dense),
            "median_dense_reprojection_error_px": _rounded(self.dense_errors, np.median),
            "dense_points_by_views": {str(n): count for n, count in sorted(by_views.items())},
            "cameras": {name: self._camera(name) for name in self.views},
            "seconds": {stage: round(value, 3) for stage, value in self.seconds.items()},
        }

    def _camera(self, name: str) -> dict[str, Any]:
        view, own = self.views[name], self.intrinsics[name]
        return {
            "width": own.size[0],
            "height": own.size[1],
            "model": own.model,
            "focal_px": [round(value, 3) for value in view.camera.focal_px],
            "cx": round(view.camera.centre[0], 3),
            "cy": round(view.camera.centre[1], 3),
            "colmap_params": [float(f"{value:.9g}") for value in own.params],
            "intrinsics": own.source,
            "rotation": view.rotation.tolist(),
            "translation": np.asarray(view.translation).tolist(),
            "centre": view.centre.tolist(),
        }


def _place(georeference: Georeference | str) -> dict[str, Any]:
    if isinstance(georeference, str):
        return {"scale": f"{SCALE} {georeference}"}
    return {"scale": "lengths are in metres", "georeference": georeference.summary()}


def _rounded(values: np.ndarray, function: Any) -> float | None:
    return round(float(function(values)), 4) if len(values) else None
