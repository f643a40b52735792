"""Dense points from images with known cameras.

Each image in turn is the reference. It is rectified with its best neighbours, and matched with
them row by row (`matching.guided.rectified`); `fusion` makes points of the matches.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from .._shared.opencv import cv2
from .._shared.records import file_state
from ..geometry.camera import Camera, PosedView, relative_fundamental
from ..io.image import load_image, luma
from ..matching.guided.rectified import match_by_rectification
from .fusion import MIN_VIEWS, DensePoints, angles_between, fuse_matches
from .intrinsics import CameraIntrinsics
from .mapping import SparseModel

NEIGHBOURS = 4
"""Images that each one is matched with."""

MIN_COMMON_POINTS = 30
"""Sparse points that both see."""

IDEAL_ANGLE_DEG = 5.0
"""Between the lines of sight from both: smaller ones count less."""

MAX_ANGLE_DEG = 30.0
"""Larger ones count less, since surfaces look different."""

MAX_SIDE_PX = 2000
"""Longer sides are scaled down to this."""

CACHED_IMAGES = 16
"""Prepared images that a process keeps: following references share neighbours."""


@dataclass(frozen=True, eq=False)
class Neighbour:
    """An image that a reference is matched with.

    Attributes:
        view: its camera.
        intrinsics: the same with its distortion.
        points0, points1: (K, 2) sparse matches, in pixels of the pinhole cameras of the reference
            and of this one.
    """

    view: PosedView
    intrinsics: CameraIntrinsics
    points0: np.ndarray
    points1: np.ndarray


@dataclass(frozen=True, eq=False)
class Reference:
    """An image whose pixels become points, and those that it is matched with."""

    view: PosedView
    intrinsics: CameraIntrinsics
    neighbours: tuple[Neighbour, ...]


def find_references(sparse: SparseModel) -> list[Reference]:
    """Choose the neighbours of each image: those that share many points at a good angle.

    Returns:
        The images that have enough neighbours, those that see most points first.
    """
    rows = {number: np.flatnonzero(sparse.seen.views == number) for number in sparse.views}
    found = []
    for number in sorted(rows, key=lambda number: -len(rows[number])):
        scored = []
        for other in rows:
            if other == number:
                continue
            common, own, its = np.intersect1d(
                sparse.seen.points[rows[number]],
                sparse.seen.points[rows[other]],
                return_indices=True,
            )
            if len(common) < MIN_COMMON_POINTS:
                continue
            lines = [sparse.points[common] - sparse.views[k].centre for k in (number, other)]
            angle = np.degrees(angles_between(*lines))
            weights = np.minimum(angle / IDEAL_ANGLE_DEG, 1) ** 1.5
            weights = weights * np.minimum(MAX_ANGLE_DEG / np.maximum(angle, 1e-9), 1) ** 2
            neighbour = Neighbour(
                sparse.views[other],
                sparse.intrinsics[other],
                sparse.seen.xy[rows[number][own]],
                sparse.seen.xy[rows[other][its]],
            )
            scored.append((float(weights.sum()), neighbour))
        scored.sort(key=lambda each: -each[0])
        best = tuple(neighbour for _, neighbour in scored[:NEIGHBOURS])
        if len(best) + 1 >= MIN_VIEWS:
            found.append(Reference(sparse.views[number], sparse.intrinsics[number], best))
    return found


def dense_points(folder: Path, reference: Reference, stride_px: int) -> DensePoints:
    """Match a reference with its neighbours, and return the points that enough of them agree on.

    Args:
        folder: of the images.
        reference: with its neighbours.
        stride_px: a point is sought at every so many pixels of a row and of a column.

    Raises:
        ImageError: an image cannot be read any more.
    """
    path = folder / reference.view.name
    rgb = _prepared_image(path, file_state(path), reference.intrinsics)
    gray, view = luma(rgb), limited_view(reference.view)
    scale = view.camera.size[0] / reference.view.camera.size[0]
    height, width = gray.shape
    y, x = np.mgrid[0:height:stride_px, 0:width:stride_px]
    xy = np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)
    views, matches = [], []
    for neighbour in reference.neighbours:
        path = folder / neighbour.view.name
        other = _prepared_image(path, file_state(path), neighbour.intrinsics)
        its_view = limited_view(neighbour.view)
        its_scale = its_view.camera.size[0] / neighbour.view.camera.size[0]
        found = match_by_rectification(
            gray,
            luma(other),
            xy,
            _scaled(neighbour.points0, scale),
            _scaled(neighbour.points1, its_scale),
            relative_fundamental(view, its_view),
            exact=True,
        )
        if found is None:
            continue
        places = np.full((len(xy), 2), np.nan)
        places[found[1].indices0] = found[1].points1
        views.append(its_view)
        matches.append(places)
    points, errors, counts = fuse_matches(view, xy, views, matches)
    kept = np.flatnonzero(counts)
    return DensePoints(
        points[kept].astype(np.float32),
        rgb[y.ravel()[kept], x.ravel()[kept]],
        errors[kept].astype(np.float32),
        counts[kept].astype(np.uint8),
    )


@lru_cache(maxsize=CACHED_IMAGES)
def _prepared_image(path: Path, state: tuple[int, int], intrinsics: CameraIntrinsics) -> np.ndarray:
    """Read an image of this `file_state` without its distortion, at most `MAX_SIDE_PX` long."""
    rgb = intrinsics.undistort(load_image(path))
    size = _limited_size(intrinsics.size)
    if size != intrinsics.size:
        rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    return rgb


def _limited_size(size: tuple[int, int]) -> tuple[int, int]:
    scale = min(1.0, MAX_SIDE_PX / max(size))
    return round(size[0] * scale), round(size[1] * scale)


def limited_view(view: PosedView) -> PosedView:
    """Return a view of at most `MAX_SIDE_PX`."""
    width, height = view.camera.size
    size = _limited_size(view.camera.size)
    if size == view.camera.size:
        return view
    across, down = size[0] / width, size[1] / height
    (fx, fy), (cx, cy) = view.camera.focal_px, view.camera.centre
    centre = ((cx + 0.5) * across - 0.5, (cy + 0.5) * down - 0.5)
    return replace(view, camera=Camera(size, (fx * across, fy * down), centre))


def _scaled(xy: np.ndarray, scale: float) -> np.ndarray:
    """Return positions in an image that has been scaled."""
    return np.asarray((xy + 0.5) * scale - 0.5)
