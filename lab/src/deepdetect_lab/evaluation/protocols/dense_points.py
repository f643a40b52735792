"""Measure which share of each image dense points cover, and how accurate their depths are.

The accuracy is estimated without ground truth: two halves of the images are reconstructed
separately, and their depths are compared. OpenCV's semi-global matching and the clouds of other
programs, such as OpenMVS or COLMAP, are measured for comparison.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import plyfile

from deepdetect._shared.errors import InvalidFileError, MissingFileError, NoDepthError, first_line
from deepdetect._shared.opencv import cv2
from deepdetect.detector.point_detector import PointDetector
from deepdetect.geometry.camera import Camera, PosedView
from deepdetect.sfm.colmap import import_pycolmap, initial_intrinsics
from deepdetect.sfm.depth_maps import find_references, limited_view, prepared_image
from deepdetect.sfm.fusion import merge_dense_points, nearest_depths
from deepdetect.sfm.mapping import SparseModel, read_sparse_model
from deepdetect.sfm.stages import MultiViewOptions, Stages

from ..report import Row, Rows
from .stereo_pipelines import sgbm_disparity

SGBM = "SGBM, OpenCV"

APART = 0.01
"""Two depths of a pixel are "apart" if their relative difference exceeds this. Chosen by hand."""

DENSE_COLUMNS = {
    "scene": "",
    "depth maps": "",
    "points": ",d",
    "share, own map": ".3f",
    "share, all maps": ".3f",
    "median error, px": ".3f",
    "halves: median difference": ".5f",
    "halves: share apart": ".4f",
    "CPU s an image": ".1f",
}

DENSE_NOTE = (
    "True intrinsics are used where they are known. Share, own map: fraction of the pixels of an "
    "image that have a point in its own depth map; share, all maps: fraction of the pixels that "
    "see any point of the fused cloud; both are means over the images. Error: distance in "
    "pixels between a point and the matches of the image whose depth map gave the point. Halves: "
    "every other image belongs to the first half, the rest to the second, and each half gets its "
    "own dense points. Where an image sees points of both halves, the columns give the relative "
    "difference of the two depths and the share of differences over 1 %. CPU seconds: time for the "
    "depth maps and their fusion. SGBM: each image is rectified with its best neighbour by the "
    "same cameras and matched. Instead of halves, the depths of an image from its best and from "
    "its second-best neighbour are compared."
)


CELL_PX = 4
"""Clouds are compared in square cells of the images with this side in pixels, because some clouds
have points at every second pixel only. Chosen by hand."""

CLOUD_COLUMNS = {
    "cloud": "",
    "points": ",d",
    "share": ".3f",
    "from the first: median difference": ".5f",
    "from the first: share apart": ".4f",
}

CLOUD_NOTE = (
    "Each image, scaled down to at most 2,000 pixels a side, is divided into cells of 4x4 pixels. "
    "Share: fraction of the cells that see a point of the cloud, mean over the images. From the "
    "first: in cells that see this cloud and the first cloud, the relative difference of the two "
    "depths (median), and the share of cells in which the difference is over 1 %."
)


def compare_clouds(model: Path, clouds: Sequence[Path]) -> Rows:
    """Compare point clouds in PLY files as seen by the cameras of a COLMAP model, `model`/sparse/0.

    The clouds must be in the model's coordinate frame. Returns a row of `CLOUD_COLUMNS` for each
    cloud. Raises a DeepDetectError if a file cannot be read.
    """
    sparse = model / "sparse" / "0"
    if not sparse.is_dir():
        raise MissingFileError(f"there is no folder {sparse}: name the folder of a reconstruction")
    pycolmap = import_pycolmap()
    try:
        views = read_sparse_model(pycolmap.Reconstruction(sparse)).views.values()
    except (ValueError, IndexError, RuntimeError) as error:
        raise InvalidFileError(
            f"{sparse} is not a readable COLMAP model ({first_line(error)}): check the folder"
        ) from error
    limited = [limited_view(view) for view in views]
    rows: Rows = []
    first: list[np.ndarray] = []
    for path in clouds:
        points = read_ply_points(path)
        depths = [nearest_depths(view, [points], CELL_PX) for view in limited]
        share = np.mean([np.isfinite(depth).mean() for depth in depths])
        row = {"cloud": str(path), "points": len(points), "share": float(share)}
        if first:
            row |= _agreement([*zip(depths, first, strict=True)], "from the first")
        first = first or depths
        rows.append(row)
    return rows


def measure_dense_points(
    images: Sequence[Path], cameras: Mapping[str, Camera], detector: PointDetector
) -> Row:
    """Reconstruct dense points from images and measure them. Call it in a separate process.

    `cameras` are the true intrinsics by file name; if it is empty, they are estimated. Returns the
    values of `DENSE_COLUMNS` from "points" on, and those of semi-global matching under the same
    names with the prefix "SGBM, OpenCV ". If the cameras cannot be reconstructed, it returns
    {"points": 0}.
    """
    with tempfile.TemporaryDirectory(prefix="deepdetect-dense-") as scratch:
        options = MultiViewOptions(pairs="exhaustive")
        stages = Stages(Path(scratch) / "model", options, 1, True)
        folder = stages.folder_of(images)
        sizes = stages.extract(folder, detector)[0]
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
        counts = {view.name: len(points) for view, points in parts}
        made = [[dense["points"]], *([stages.dense(folder, k)["points"]] for k in _halves(sparse))]
        shares, pairs = [], []
        for view in views:
            whole, *halves = (nearest_depths(view, points, stride) for points in made)
            shares.append((counts.get(view.name, 0) / whole.size, np.isfinite(whole).mean()))
            pairs.append(halves)
        share = np.mean(shares, axis=0)
        row = {
            "points": len(dense),
            "share, own map": float(share[0]),
            "share, all maps": float(share[1]),
            "median error, px": float(np.median(dense["errors"])),
            **_agreement(pairs),
            "CPU s an image": seconds / len(views),
        }
        start, pairs = time.process_time(), []
        for image, first, second, *_ in find_references(sparse):
            own, *others = (prepared_image(folder, each) for each in (image, first, second))
            clouds = (_sgbm_points(own, other, sparse.points) for other in others)
            pairs.append([nearest_depths(own[1], [cloud], stride) for cloud in clouds])
        sgbm = {
            "share, own map": float(np.mean([np.isfinite(first).mean() for first, _ in pairs])),
            **_agreement(pairs),
            "CPU s an image": (time.process_time() - start) / (2 * len(pairs)),
        }
        return row | {f"{SGBM} {name}": value for name, value in sgbm.items()}


def _agreement(pairs: Sequence[Sequence[np.ndarray]], name: str = "halves") -> Row:
    """Compare the depth maps of each pair; `name` begins the column titles of the result."""
    differences = []
    for first, second in pairs:
        both = np.isfinite(first) & np.isfinite(second)
        differences.append(np.abs(first[both] / second[both] - 1))
    difference = np.concatenate(differences)
    if not len(difference):
        return {}
    return {
        f"{name}: median difference": float(np.median(difference)),
        f"{name}: share apart": float((difference > APART).mean()),
    }


def _sgbm_points(
    one: tuple[np.ndarray, PosedView], other: tuple[np.ndarray, PosedView], seen: np.ndarray
) -> np.ndarray:
    """Return the (N, 3) points in the world that SGBM finds in two images.

    The range of disparities is that of the sparse points `seen`, (M, 3).
    """
    (rgb0, view0), (rgb1, view1) = one, other
    moved = view1.relative_to(view0)
    size, matrices = view0.camera.size, [view.camera.matrix for view in (view0, view1)]
    turn0, turn1, first, second, *_ = cv2.stereoRectify(
        matrices[0],
        None,
        matrices[1],
        None,
        size,
        moved.rotation,
        moved.translation[:, None],  # OpenCV 5 requires a column
        flags=0,
        alpha=-1,
    )
    views = [
        cv2.remap(rgb, *cv2.initUndistortRectifyMap(matrix, None, turn, projection, size, 5), 1)
        for rgb, matrix, turn, projection in zip(
            (rgb0, rgb1), matrices, (turn0, turn1), (first, second), strict=True
        )
    ]
    # If one camera is above the other, rectified views have matches in one column, not in one row.
    axis = int(abs(second[1, 3]) > abs(second[0, 3]))
    if axis:
        views = [np.ascontiguousarray(view.transpose(1, 0, 2)) for view in views]
    within = ((view0.project(seen)[0] >= 0) & (view0.project(seen)[0] < size)).all(axis=1)
    depths = ((seen @ view0.rotation.T + view0.translation) @ turn0.T)[within, 2]
    scale, offset = -float(second[axis, 3]), float(first[axis, 2] - second[axis, 2])
    low, high = offset + np.quantile(scale / depths[depths > 0], [0.01, 0.99])
    lowest, count = math.floor(low) - 16, 16 * math.ceil((high - low + 32) / 16)
    borders_px = max(lowest + count, 0), max(-lowest, 0)
    if sum(borders_px) > max(size):  # the rectified images hardly overlap
        return np.empty((0, 3))
    disparity = sgbm_disparity(views[0], views[1], count, borders_px, lowest)
    disparity = disparity.T if axis else disparity
    ahead = scale / (disparity - offset)
    row, column = np.nonzero(ahead > 0)
    rays = np.column_stack([column, row, np.ones(len(row))]) @ np.linalg.inv(first[:, :3]).T
    places = rays * ahead[row, column][:, None]
    return (places @ turn0 - view0.translation) @ view0.rotation


def _halves(sparse: SparseModel) -> list[SparseModel]:
    names = sorted(sparse.images)
    return [
        replace(sparse, images={name: sparse.images[name] for name in names[k::2]}) for k in (0, 1)
    ]


def read_ply_points(path: Path) -> np.ndarray:
    """Read the points of a PLY file from any program, (N, 3) float64, without non-finite ones.

    The package plyfile reads them, because files of OpenMVS contain lists, on which the readers of
    OpenCV, COLMAP and trimesh fail. Raises an InvalidFileError if it is not a PLY point cloud.
    """
    try:
        head, end, rest = path.read_bytes().partition(b"end_header")
        # plyfile accepts only ASCII in the header, but comments may contain other characters.
        head = head.decode("ascii", "replace").encode("ascii", "replace")
        vertices = plyfile.PlyData.read(BytesIO(head + end + rest))["vertex"]
        points = np.column_stack([vertices[axis] for axis in "xyz"]).astype(np.float64)
    except FileNotFoundError:
        raise MissingFileError(f"there is no file {path}: check the path") from None
    except (plyfile.PlyParseError, OSError, KeyError, ValueError, MemoryError) as error:
        reason = first_line(error) or type(error).__name__
        raise InvalidFileError(f"{path} is not a PLY point cloud ({reason}): check it") from error
    return points[np.isfinite(points).all(axis=1)]
