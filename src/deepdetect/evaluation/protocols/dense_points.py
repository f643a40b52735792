"""Dense points of many images: how much of the images they cover, and whether halves agree."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..._shared.errors import NoDepthError
from ...detector.point_detector import PointDetector
from ...geometry.camera import Camera
from ...sfm.colmap import initial_intrinsics
from ...sfm.dense import limited_view, merge_dense_points, nearest_depths
from ...sfm.mapping import SparseModel, read_sparse_model
from ...sfm.pipeline import MAX_KEYPOINTS
from ...sfm.stages import MultiViewOptions, Stages
from ..report import Row

APART = 0.01
"""Relative difference of two depths that are not of one surface."""

DENSE_COLUMNS = {
    "scene": "",
    "points": ",d",
    "share, own map": ".3f",
    "share, all maps": ".3f",
    "median error, px": ".3f",
    "halves: median difference": ".5f",
    "halves: share apart": ".4f",
    "CPU s an image": ".1f",
}

DENSE_NOTE = (
    "With true intrinsics, where these are known. Share: of the pixels that are tried in "
    "an image, those with a point by its own depth map, and those that any point is seen at; mean "
    "over the images. Error: from a point to the matches of its image alone. Halves: every other "
    "image makes points without the others; of the pixels at which both have one, the relative "
    "difference of the depths, and the share of those that differ by over 1 %. CPU seconds: of "
    "depth maps and their fusion."
)


def measure_dense_points(images: Sequence[Path], cameras: Mapping[str, Camera]) -> Row:
    """Make dense points of images; to be called in a process of its own.

    Returns the `DENSE_COLUMNS` but the scene; only "points", 0, where there is no model.
    """
    with tempfile.TemporaryDirectory(prefix="deepdetect-dense-") as scratch:
        options = MultiViewOptions(pairs="exhaustive")
        stages = Stages(Path(scratch) / "model", options, 1, True)
        folder = stages.folder_of(images)
        sizes = stages.extract(folder, PointDetector(MAX_KEYPOINTS))[0]
        matches = stages.match(stages.choose_pairs(list(sizes)))
        intrinsics = initial_intrinsics(folder, sizes, cameras)
        try:
            model = stages.map(folder, intrinsics, matches, bool(cameras))[0]
        except NoDepthError:
            return {"points": 0}
        sparse = read_sparse_model(model)
        views = [limited_view(view) for view in sparse.views.values()]
        stride = options.stride_px
        start = time.process_time()
        parts = [*stages.fused(folder, sparse)]
        dense = merge_dense_points(parts, stride)
        seconds = time.process_time() - start
        own = {view.name: len(points) for view, points in parts}
        made = [[dense["points"]], *([stages.dense(folder, k)["points"]] for k in _halves(sparse))]
        shares, differences = [], []
        for view in views:
            whole, first, second = (nearest_depths(view, points, stride) for points in made)
            shares.append((own.get(view.name, 0) / whole.size, np.isfinite(whole).mean()))
            both = np.isfinite(first) & np.isfinite(second)
            differences.append(np.abs(first[both] / second[both] - 1))
        share, difference = np.mean(shares, axis=0), np.concatenate(differences)
        return {
            "points": len(dense),
            "share, own map": float(share[0]),
            "share, all maps": float(share[1]),
            "median error, px": float(np.median(dense["errors"])),
            "halves: median difference": float(np.median(difference)),
            "halves: share apart": float((difference > APART).mean()),
            "CPU s an image": seconds / len(views),
        }


def _halves(sparse: SparseModel) -> list[SparseModel]:
    names = sorted(sparse.images)
    return [
        replace(sparse, images={name: sparse.images[name] for name in names[k::2]}) for k in (0, 1)
    ]
