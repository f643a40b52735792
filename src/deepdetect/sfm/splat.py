"""Write inputs for the training of radiance fields and Gaussian splats: images, cameras, points."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.atomic import write_whole
from .._shared.opencv import cv2
from ..geometry.camera import PosedView
from ..io.depth import depth_scale, save_depth_png
from ..io.image import load_image
from .colmap import PIXEL_CENTRE, CameraIntrinsics, quiet_pycolmap
from .result import MultiViewReconstruction

SPLAT_POINTS = 200_000
"""Training starts from at most this number of dense points. Chosen by hand."""

JPEG_QUALITY = 95

CELLS_PX, CLOSED_GAIN = (1, 2, 3, 4, 6, 8), 1.3
"""Each point covers a square of a depth map. Its side in pixels is the first of `CELLS_PX` at which
the next would cover under `CLOSED_GAIN` times the area: few gaps are left then. Chosen by hand."""

MAX_DEPTH_STEP = 0.1
"""A pixel whose depth exceeds a neighbour's by more than this fraction is left out: it is seen
through a gap in a nearer surface. Chosen by hand."""

DEPTH_PERCENT = 95.0
"""The depths of this percentage of the sparse points in each view must fit into 16 bits."""

MAX_VALUE_PER_UNIT = 1000.0
"""Depth maps store thousandths of the model's unit, or coarser steps if 16 bits are too few."""

OPENGL = np.diag([1.0, -1, -1, 1])
"""This maps nerfstudio's camera axes (y up, z backward) to this package's (y down, z forward)."""


def write_transforms(
    path: Path,
    views: Mapping[str, PosedView],
    intrinsics: Mapping[str, CameraIntrinsics],
    files: Mapping[str, Mapping[str, Path]],
    points: Path,
    **more: Any,
) -> None:
    """Write nerfstudio's transforms.json, with the point cloud `points` and `more` top-level keys.

    `files` maps a JSON key, such as "file_path", to the file of each image, by image name.
    """

    def relative(file: Path) -> str:
        # Symbolic links are resolved first, because ".." behind one leads to the link's target.
        file = file.resolve()
        try:
            return Path(os.path.relpath(file, path.parent.resolve())).as_posix()
        except ValueError:  # on Windows, the file is on another drive
            return file.as_posix()

    frames = []
    for name, view in views.items():
        own, pinhole, world = intrinsics[name], intrinsics[name].pinhole, np.eye(4)
        world[:3] = np.column_stack([view.rotation.T, view.centre])
        numbers = [*own.size, *pinhole.focal_px, *np.add(pinhole.centre, PIXEL_CENTRE).tolist()]
        frames.append(
            {key: relative(paths[name]) for key, paths in files.items()}
            | dict(zip(("w", "h", "fl_x", "fl_y", "cx", "cy"), numbers, strict=True))
            | {"k1": own.params[3] if own.distorts else 0.0}
            | {"transform_matrix": (world @ OPENGL).tolist()}
        )
    values = {"camera_model": "OPENCV", "ply_file_path": relative(points), **more}
    write_whole(path, json.dumps({**values, "frames": frames}, indent=1) + "\n")


def write_splat(found: MultiViewReconstruction, folder: Path, output: Path) -> None:
    """Write splat/: undistorted images/, sparse/0, depths/ (16-bit PNG), and transforms.json.

    The original program for Gaussian splatting assumes that the principal point is in the middle of
    the image. Images where it is elsewhere are therefore cropped, and a warning says so.

    The model in sparse/0 has the sparse points with their tracks, and at most `SPLAT_POINTS` of the
    dense points, chosen evenly in space.
    """
    target = output / "splat"
    centred = {own: own.centred for own in {*found.intrinsics.values()}}
    lost = [np.subtract(own.without_border.size, new.size) for own, new in centred.items()]
    across, down = np.max(lost, axis=0)
    if across or down:
        warnings.warn(
            f"the images in {target.name}/ are cropped by up to {across} pixels in width and "
            f"{down} in height, so that their principal points are in the middle, as the original "
            "program for Gaussian splatting assumes",
            UserWarning,
            stacklevel=2,
        )
    intrinsics = {name: centred[own] for name, own in found.intrinsics.items()}
    views = {n: replace(view, camera=intrinsics[n].pinhole) for n, view in found.views.items()}
    kept = (".jpg", ".jpeg", ".png")
    names = {n: n if Path(n).suffix.lower() in kept else f"{n}.jpg" for n in views}
    images = {name: target / "images" / names[name] for name in views}
    depths = {name: target / "depths" / f"{names[name]}.png" for name in views}
    reach = max(
        float(np.percentile(view.project(found.sparse.points)[1], DEPTH_PERCENT))
        for view in views.values()
    )
    scale = min(MAX_VALUE_PER_UNIT, depth_scale(reach))
    for name, view in views.items():
        rgb = load_image(folder / name, max_megapixels=np.inf)
        rgb = found.intrinsics[name].undistort(rgb, view.camera)
        quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
        _, data = cv2.imencode(images[name].suffix, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), quality)
        write_whole(images[name], data.tobytes())
        seen = seen_depths(view, found.cloud.points)
        save_depth_png(seen, depths[name], found.cloud.unit, scale)
    chosen = thinned(found.dense.points, found.dense_errors, SPLAT_POINTS)
    with quiet_pycolmap() as pycolmap:
        model = pycolmap.Reconstruction(output / "sparse" / "0")
        for image in model.images.values():
            old, new = found.intrinsics[image.name], intrinsics[image.name]
            xy = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
            moved = new.pinhole.project(old.pinhole.rays(old.to_pinhole(xy - PIXEL_CENTRE)))
            for point, place in zip(image.points2D, moved, strict=True):
                point.xy = place + PIXEL_CENTRE
        for image in model.images.values():  # a second loop, because images share cameras
            camera, pinhole = image.camera, intrinsics[image.name].colmap_camera()
            camera.model, camera.params = pinhole.model, pinhole.params
            camera.width, camera.height = pinhole.width, pinhole.height
            image.name = names[image.name]
        for row in chosen:
            point = found.dense.points[row], pycolmap.Track(), found.dense.colors[row]
            model.points3D[model.add_point3D(*point)].error = found.dense_errors[row]
        (target / "sparse" / "0").mkdir(parents=True, exist_ok=True)
        model.write(target / "sparse" / "0")
        model.export_PLY(target / "points.ply")
    files = {"file_path": images, "depth_file_path": depths}
    what = target / "transforms.json", views, intrinsics, files, target / "points.ply"
    write_transforms(*what, depth_unit_scale_factor=1 / scale)


def thinned(points: np.ndarray, errors: np.ndarray, count: int) -> np.ndarray:
    """Return the indices of at most `count` points (N, 3): the most accurate in each cubic cell."""
    order = np.argsort(errors, kind="stable")
    if len(points) <= count:
        return order
    low, high = 0.0, float(np.ptp(points, axis=0).max())
    best = order[:1]
    for _ in range(20):  # bisect the cell size, to a millionth of the extent
        cell = (low + high) / 2
        cells = np.floor((points[order] - points.min(axis=0)) / cell).astype(np.int64)
        keys = cells @ np.array([1, 2_097_152, 2_097_152**2])  # a key per cell, 21 bits per axis
        if len(rows := np.unique(keys, return_index=True)[1]) > count:
            low = cell
        else:
            high, best = cell, order[rows]
    return np.sort(best)


def seen_depths(view: PosedView, points: np.ndarray) -> np.ndarray:
    """Return the depth map (H, W) of points (N, 3) in a view, NaN where no point is seen."""
    width, height = view.camera.size
    xy, depth = view.project(points)
    inside = (depth > 0) & ((xy > -0.5) & (xy < (width - 0.5, height - 0.5))).all(axis=1)
    xy, depth = xy[inside], depth[inside]
    chosen, covered = (1, np.full((height, width), np.inf)), 0.0
    for side in CELLS_PX:
        nearest = np.full((-(-height // side), -(-width // side)), np.inf)
        column, row = ((xy + 0.5) // side).astype(np.int64).T
        np.minimum.at(nearest, (row, column), depth)
        area = np.isfinite(nearest).sum() * side**2
        if area < CLOSED_GAIN * covered:
            break
        chosen, covered = (side, nearest), area
    side, nearest = chosen
    beside = cv2.erode(nearest, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)
    nearest[nearest > (1 + MAX_DEPTH_STEP) * beside] = np.inf
    nearest[np.isinf(nearest)] = np.nan
    return np.repeat(np.repeat(nearest, side, 0), side, 1)[:height, :width]
