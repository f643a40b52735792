"""Dense points from images with known cameras.

Each image in turn is the reference. It is rectified with its best neighbours, and matched with
them row by row. A pixel becomes a point where enough views agree with one position in space.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from .._shared.opencv import cv2
from .._shared.records import file_state
from ..geometry.camera import PosedView, angles_between, relative_fundamental
from ..geometry.transforms import scaled_points
from ..io.image import load_image, luma
from ..matching.guided.rectified import match_by_rectification
from .colmap import CameraIntrinsics
from .mapping import RegisteredImage, SparseModel

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

BLOCK = 50_000
"""Pixels that are triangulated at once, which bounds the memory."""

REWEIGHTINGS = 2
"""Of the linear triangulation, after which it minimises distances in pixels."""

MIN_VIEWS = 3
"""Images that must agree on a point, the reference among them."""

MAX_ERROR_PX = 1.0
"""Between a match and the projection of the point that it agrees with."""

MIN_TRIANGULATION_DEG = 1.0
"""Smallest angle between two of the lines of sight."""

DUPLICATE_DEPTH = 0.01
"""Of a point that another reference has given already, the relative difference of the depths."""


DENSE_POINT = np.dtype(
    [
        ("points", np.float32, 3),
        ("errors", np.float32),
        ("colors", np.uint8, 3),
        ("views", np.uint8),
    ]
)
"""A point that several images agree on, its distance in pixels from their matches (root mean square
of all of them), its sRGB colour, and how many these are."""


def find_references(sparse: SparseModel) -> list[list[RegisteredImage]]:
    """Choose the neighbours of each image: those that share many points at a good angle.

    Returns images, those that see most points first, each with its neighbours, the best first.
    """
    found = []
    for image in sorted(sparse.images.values(), key=lambda image: -len(image.points)):
        scored: list[tuple[float, RegisteredImage]] = []
        for other in sparse.images.values():
            common = np.intersect1d(image.points, other.points)
            if other is image or len(common) < MIN_COMMON_POINTS:
                continue
            lines = [sparse.points[common] - each.view.centre for each in (image, other)]
            angle = np.degrees(angles_between(*lines))
            weights = np.minimum(angle / IDEAL_ANGLE_DEG, 1) ** 1.5
            weights = weights * np.minimum(MAX_ANGLE_DEG / np.maximum(angle, 1e-9), 1) ** 2
            scored.append((float(weights.sum()), other))
        scored.sort(key=lambda each: -each[0])
        images = [image, *(other for _, other in scored[:NEIGHBOURS])]
        if len(images) >= MIN_VIEWS:
            found.append(images)
    return found


def dense_points(folder: Path, images: Sequence[RegisteredImage], stride_px: int) -> np.ndarray:
    """Match the first image with the others, and return what enough of them agree on (DENSE_POINT).

    A point is sought at every `stride_px` pixels of a row and of a column.
    """
    reference, *neighbours = images
    rgb, view, scale = _prepared(folder, reference)
    gray = luma(rgb)
    height, width = gray.shape
    y, x = np.mgrid[0:height:stride_px, 0:width:stride_px]
    xy = np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)
    views, positions = [view], [xy]
    for neighbour in neighbours:
        other, its_view, its_scale = _prepared(folder, neighbour)
        _, own, its = np.intersect1d(reference.points, neighbour.points, return_indices=True)
        found = match_by_rectification(
            (gray, luma(other)),
            xy,
            (
                scaled_points(reference.xy[own], scale),
                scaled_points(neighbour.xy[its], its_scale),
            ),
            relative_fundamental(view, its_view),
            exact=True,
        )
        if found is None:
            continue
        matched = np.full((len(xy), 2), np.nan)
        matched[found[1].indices0] = found[1].points1
        views.append(its_view)
        positions.append(matched)
    stacked = np.stack(positions)
    blocks = [fuse_matches(views, stacked[:, k : k + BLOCK]) for k in range(0, len(xy), BLOCK)]
    points, errors, counts = (np.concatenate(values) for values in zip(*blocks, strict=True))
    kept = np.flatnonzero(counts)
    made = np.empty(len(kept), DENSE_POINT)
    made["points"], made["errors"], made["views"] = points[kept], errors[kept], counts[kept]
    made["colors"] = rgb[y.ravel()[kept], x.ravel()[kept]]
    return made


def _prepared(folder: Path, image: RegisteredImage) -> tuple[np.ndarray, PosedView, float]:
    """Return an image without its distortion at most `MAX_SIDE_PX` long, its view, its scale."""
    path, view = folder / image.view.name, limited_view(image.view)
    rgb = _prepared_image(path, file_state(path), image.intrinsics, view.camera.size)
    return rgb, view, view.camera.size[0] / image.view.camera.size[0]


@lru_cache(maxsize=CACHED_IMAGES)
def _prepared_image(
    path: Path, state: tuple[int, int], intrinsics: CameraIntrinsics, size: tuple[int, int]
) -> np.ndarray:
    """Read an image of this `file_state`, which extraction has let pass, without its distortion."""
    rgb = intrinsics.undistort(load_image(path, max_megapixels=np.inf))
    if size != intrinsics.size:
        rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    return rgb


def limited_view(view: PosedView) -> PosedView:
    """Return a view of at most `MAX_SIDE_PX`."""
    width, height = view.camera.size
    scale = MAX_SIDE_PX / max(width, height)
    if scale >= 1:
        return view
    camera = view.camera.scaled((round(width * scale), round(height * scale)))
    return replace(view, camera=camera)


def fuse_matches(
    views: Sequence[PosedView], places: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the points (N, 3) that positions (V, N, 2) in views, NaN where unknown, agree on.

    The match of each view in turn gives a point with the position in the first one, with which
    those of other views agree or not. The point with most agreement is triangulated again from all
    that agree. Returns points, errors as of `DENSE_POINT`, and the number of views that agree, 0
    where there is no point.
    """
    known = np.isfinite(places).all(axis=2)
    agreeing = np.zeros(known.shape, bool)
    most = np.zeros(places.shape[1], np.int64)
    for k in range(1, len(views)):
        if not known[k].any():
            continue
        alone = np.zeros(known.shape, bool)
        alone[0] = alone[k] = known[k]
        points = _triangulate(views, places, alone)
        distance, _ = _distances(views, places, points)
        agree = known & known[k] & (distance < MAX_ERROR_PX)
        number = agree.sum(axis=0)
        better = agree[0] & agree[k] & (number > most)
        agreeing[:, better], most[better] = agree[:, better], number[better]
    points = _triangulate(views, places, agreeing)
    distance, depth = _distances(views, places, points)
    number = agreeing.sum(axis=0)
    squares = np.where(agreeing, distance**2, 0).sum(axis=0)
    errors = np.sqrt(squares / np.maximum(number, 1))
    ahead = np.where(agreeing, depth > 0, True).all(axis=0)
    rays = [points - view.centre for view in views]
    angles = [np.degrees(angles_between(rays[0], other)) for other in rays]
    angle = np.where(agreeing, angles, 0).max(axis=0)
    good = (
        (number >= MIN_VIEWS)
        & np.isfinite(points).all(axis=1)
        & ahead
        & (errors < MAX_ERROR_PX)
        & (angle >= MIN_TRIANGULATION_DEG)
    )
    return points, errors, np.where(good, number, 0)


def _triangulate(views: Sequence[PosedView], places: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Triangulate (N, 3) points from positions (V, N, 2) in the views that are used (V, N).

    Linear, weighted by depths: after some rounds the least squares of distances in pixels.
    """
    count = places.shape[1]
    points = np.full((count, 3), np.nan)
    depth = np.ones(places.shape[:2])
    for _ in range(1 + REWEIGHTINGS):
        normal = np.zeros((count, 3, 3))
        right = np.zeros((count, 3))
        for k, view in enumerate(views):
            weight = np.where(used[k], 1 / depth[k], 0)
            projection = view.projection
            for axis in (0, 1):
                where = np.where(used[k], places[k, :, axis], 0)
                row = (where[:, None] * projection[2] - projection[axis]) * weight[:, None]
                normal += row[:, :3, None] * row[:, None, :3]
                right -= row[:, :3] * row[:, 3:]
        solvable = (used.sum(axis=0) >= 2) & (np.linalg.det(normal) > 0)
        points[solvable] = np.linalg.solve(normal[solvable], right[solvable, :, None])[:, :, 0]
        for k, view in enumerate(views):
            seen = np.abs(points @ view.rotation[2] + view.translation[2])
            depth[k] = np.where(np.isfinite(seen) & (seen > 1e-9), seen, 1)
    return points


def _distances(
    views: Sequence[PosedView], places: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return (V, N) distances of projections from positions, infinite behind a view; depths."""
    distances, depths = np.full(places.shape[:2], np.inf), np.full(places.shape[:2], -1.0)
    for k, view in enumerate(views):
        projected, depth = view.project(points)
        distance = np.linalg.norm(projected - places[k], axis=1)
        fine = np.isfinite(distance) & (depth > 0)
        distances[k, fine], depths[k, fine] = distance[fine], depth[fine]
    return distances, depths


def merge_dense_points(parts: Sequence[tuple[PosedView, np.ndarray]], stride_px: int) -> np.ndarray:
    """Join the points of all references, without those that an earlier one has given already."""
    kept = [np.empty(0, DENSE_POINT)]
    for view, own in parts:
        seen = _nearest_depths(view, kept, stride_px)
        projected, depth = view.project(own["points"])
        cells = np.rint(projected / stride_px).astype(np.int64)
        column, row = cells.clip(0, np.array(seen.shape[::-1]) - 1).T
        kept.append(own[np.abs(seen[row, column] - depth) > DUPLICATE_DEPTH * depth])
    return np.concatenate(kept)


def _nearest_depths(view: PosedView, parts: Sequence[np.ndarray], stride_px: int) -> np.ndarray:
    """Return the depth of the nearest point in each cell of a view, infinite without any."""
    columns, rows = (-(-side // stride_px) for side in view.camera.size)
    nearest = np.full((rows, columns), np.inf)
    for part in parts:
        projected, depth = view.project(part["points"])
        cells = np.rint(np.where(depth[:, None] > 0, projected, -1e6) / stride_px)
        inside = ((cells >= 0) & (cells < (columns, rows))).all(axis=1)
        column, row = cells[inside].astype(np.int64).T
        np.minimum.at(nearest, (row, column), depth[inside])
    return nearest
