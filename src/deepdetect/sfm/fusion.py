"""Dense points: what the depth maps of several images agree on."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import compress, product

import numpy as np

from .._shared.machine import parallel_for
from .._shared.opencv import cv2
from ..geometry.camera import PosedView
from .depth_maps import MIN_VIEWS, relative_projections

MAX_ERROR_PX = 1.0
"""Between a pixel and where the surface of another depth map is seen."""

MAX_DEPTH_DIFFERENCE = 0.01
"""Of two depth maps that agree, relative."""

EDGE_RADIUS, ENOUGH_VIEWS = 4, 5
"""Pixels of a depth map from a farther surface within which so many images must agree; they are
enough everywhere."""

SUPPORT_SIDE, MIN_SUPPORT = 21, 0.6
"""Side of the square of pixels of a depth map around one, and the share of them that `MIN_VIEWS` or
more must agree on, too: small patches apart are where most wrong points are."""

SUPPORTED_RADIUS, MIN_SUPPORTED_VIEWS = 4, 2
"""Pixels of a depth map from such a one within which so many images are enough: holes of a surface
are where others show through."""

MIN_TRIANGULATION_DEG = 1.0
"""Smallest angle between two of the lines of sight."""

DUPLICATE_DEPTH = 0.01
"""Of a point that another reference has given already, the relative difference of the depths."""

DENSE_POINT = np.dtype(
    [
        ("points", np.float32, 3),
        ("normals", np.float32, 3),
        ("errors", np.float32),
        ("colors", np.uint8, 3),
        ("views", np.uint8),
    ]
)
"""A point that several images agree on, the normal of its surface, towards the reference, its
distance in pixels from the matches of the reference (root mean square), its sRGB colour, and how
many images these are."""


def fuse_depth_maps(
    views: Sequence[PosedView], maps: Sequence[np.ndarray], stride_px: int
) -> np.ndarray:
    """Return what enough depth maps (`DEPTH_PIXEL`) agree on with the first one (`DENSE_POINT`)."""
    from .dense_kernels import fuse_rows

    planes = np.ascontiguousarray(maps[0]["plane"])
    shape = np.max([each.shape for each in maps], axis=0)
    others = np.full((len(maps) - 1, *shape, 3), np.nan, np.float32)
    for page, each in zip(others, maps[1:], strict=True):
        page[: each.shape[0], : each.shape[1]] = each["plane"]
    there, back = (relative_projections(views[0], views[1:], back) for back in (False, True))
    camera = views[0].camera
    centres = [views[0].rotation @ view.centre + views[0].translation for view in views[1:]]
    inverse, count = np.empty(planes.shape[:2], np.float32), np.empty(planes.shape[:2], np.uint8)
    geometry = stride_px, there, back, np.linalg.inv(camera.matrix), np.array(centres)
    limits = MAX_ERROR_PX, MAX_DEPTH_DIFFERENCE, math.radians(MIN_TRIANGULATION_DEG)
    parallel_for(len(planes), fuse_rows, planes, others, *geometry, *limits, inverse, count)
    # Windows there give pixels beside a nearer surface its depth, in all views alike.
    known = np.nan_to_num(planes[..., 0], nan=np.inf)
    farthest = cv2.erode(known, np.ones((2 * EDGE_RADIUS + 1,) * 2, np.uint8))
    slanted = EDGE_RADIUS * stride_px * np.abs(planes[..., 1:]).sum(axis=2)
    edge = planes[..., 0] - farthest > MAX_DEPTH_DIFFERENCE * planes[..., 0] + slanted
    agreed = count >= np.where(edge, ENOUGH_VIEWS, MIN_VIEWS)
    support = cv2.boxFilter(agreed.astype(np.float32), -1, (SUPPORT_SIDE, SUPPORT_SIDE))
    sure = (agreed & (support >= MIN_SUPPORT)).astype(np.uint8)
    supported = cv2.dilate(sure, np.ones((2 * SUPPORTED_RADIUS + 1,) * 2, np.uint8)) > 0
    some = supported & ~edge & (count >= MIN_SUPPORTED_VIEWS)
    row, column = np.nonzero(some | (count >= ENOUGH_VIEWS))
    found, plane = maps[0][row, column], planes[row, column].astype(np.float64)
    xy, near = np.column_stack([column, row]) * float(stride_px), inverse[row, column]
    made = np.empty(len(row), DENSE_POINT)
    made["points"] = (camera.rays(xy) / near[:, None] - views[0].translation) @ views[0].rotation
    # The inverse depth of a plane is its normal times the line of sight, over its distance.
    ahead = near - (plane[:, 1:] * (xy - camera.centre)).sum(axis=1)
    away = np.column_stack([plane[:, 1:] * camera.focal_px, ahead]) @ views[0].rotation
    made["normals"] = -away / np.linalg.norm(away, axis=1, keepdims=True)
    made["errors"], made["colors"] = found["error"], found["color"]
    made["views"] = count[row, column]
    return made


def merge_dense_points(parts: Iterable[tuple[PosedView, np.ndarray]], stride_px: int) -> np.ndarray:
    """Join the points of all references, without those that an earlier one has given already."""
    kept, boxes = [np.empty(0, DENSE_POINT)], [np.empty((0, 3))]
    for view, own in parts:
        near = (_may_show(view, box, stride_px) for box in boxes)
        seen = nearest_depths(view, [each["points"] for each in compress(kept, near)], stride_px)
        projected, depth = view.project(own["points"])
        cells = np.rint(projected / stride_px).astype(np.int64)
        column, row = cells.clip(0, np.array(seen.shape[::-1]) - 1).T
        new = own[np.abs(seen[row, column] - depth) > DUPLICATE_DEPTH * depth]
        if len(new):
            ends = zip(new["points"].min(axis=0), new["points"].max(axis=0), strict=True)
            kept.append(new)
            boxes.append(np.array([*product(*ends)]))
    return np.concatenate(kept)


def _may_show(view: PosedView, corners: np.ndarray, margin_px: int) -> bool:
    """Whether a view may show something of a box: no side of its frustum has all corners beyond."""
    seen = (corners @ view.rotation.T + view.translation) @ view.camera.matrix.T
    xy, depth = seen[:, :2], seen[:, 2:]
    inside = [depth, xy + margin_px * depth, (np.array(view.camera.size) + margin_px) * depth - xy]
    return bool((np.hstack(inside) > 0).any(axis=0).all())


def nearest_depths(view: PosedView, parts: Sequence[np.ndarray], stride_px: int) -> np.ndarray:
    """Return the depth of the nearest of (N, 3) points in each cell of a view; infinite: none."""
    columns, rows = (-(-side // stride_px) for side in view.camera.size)
    nearest = np.full((rows, columns), np.inf)
    for points in parts:
        projected, depth = view.project(points)
        cells = np.rint(np.where(depth[:, None] > 0, projected, -1e6) / stride_px)
        inside = ((cells >= 0) & (cells < (columns, rows))).all(axis=1)
        column, row = cells[inside].astype(np.int64).T
        np.minimum.at(nearest, (row, column), depth[inside])
    return nearest
