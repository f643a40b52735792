"""Fuse the depth maps of several images into dense points."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import compress, product

import numpy as np

from .._shared.machine import parallel_for
from .._shared.opencv import cv2
from ..geometry.camera import PosedView
from .depth_maps import MIN_VIEWS, relative_projections

MAX_ERROR_PX, MAX_DEPTH_DIFFERENCE = 1.0, 0.01
"""A neighbour agrees with a pixel's depth if its own surface point reprojects to within
`MAX_ERROR_PX` of the pixel (2 px in COLMAP's fusion), and its inverse depth differs by at most the
fraction `MAX_DEPTH_DIFFERENCE` (as in COLMAP)."""

MIN_ALL_VIEWS, ENOUGH_VIEWS = 4, 5
"""A pixel becomes a point if `ENOUGH_VIEWS` images agree on its depth, or if at least
`MIN_ALL_VIEWS` images contain the point in their frame and all of them agree. Chosen by hand."""

EDGE_RADIUS_PX = 8
"""Pixels on the near side of a depth edge, up to this distance from it, must satisfy the rule of
`ENOUGH_VIEWS`: windows there give the background the foreground's depth. Chosen by hand."""

MIDDLE_SPACING_PX, MIN_MIDDLE_SHARE = 10, 0.6
"""A pixel in the middle of a surface needs only `MIN_VIEWS` images that agree, because most wrong
points are on small patches. A pixel is in the middle if, of 5 x 5 pixels `MIDDLE_SPACING_PX` apart,
at least the fraction `MIN_MIDDLE_SHARE` lie on its surface and also have `MIN_VIEWS` images that
agree. Chosen by hand."""

FILLED_RADIUS_PX, MIN_FILLED_VIEWS = 8, 2
"""Pixels within `FILLED_RADIUS_PX` of the middle of their surface need only `MIN_FILLED_VIEWS`
images that agree, because other images may not show this part of the surface. Chosen by hand."""

MIN_TRIANGULATION_DEG, DUPLICATE_DEPTH = 1.0, 0.01
"""A point is kept only if the lines of sight of the reference image and of some image that agrees
form at least `MIN_TRIANGULATION_DEG`, and no earlier point projects to the same pixel with a depth
that differs by at most the fraction `DUPLICATE_DEPTH`. Chosen by hand."""

DENSE_POINT = np.dtype(
    [
        ("points", np.float32, 3),
        ("normals", np.float32, 3),
        ("errors", np.float32),
        ("colors", np.uint8, 3),
        ("views", np.uint8),
    ]
)
"""A dense point, from a pixel of a depth map. `normals` is a unit vector facing the map's camera,
`errors` is `error` of `DEPTH_PIXEL`, `colors` is sRGB, `views` the number of images that agree."""


def fuse_depth_maps(
    views: Sequence[PosedView], maps: Sequence[np.ndarray], stride_px: int
) -> np.ndarray:
    """Return, as `DENSE_POINT`s, the pixels of the first map on which enough other maps agree."""
    from .dense_kernels import fuse_rows

    if len(maps) < MIN_FILLED_VIEWS:  # no neighbour has a depth map
        return np.empty(0, DENSE_POINT)
    planes = np.ascontiguousarray(maps[0]["plane"])
    sizes = np.array([each.shape for each in maps])
    others = np.full((len(maps) - 1, *sizes.max(axis=0), 3), np.nan, np.float32)
    for page, each in zip(others, maps[1:], strict=True):
        page[: each.shape[0], : each.shape[1]] = each["plane"]
    there, back = (relative_projections(views[0], views[1:], back) for back in (False, True))
    camera = views[0].camera
    centres = [views[0].rotation @ view.centre + views[0].translation for view in views[1:]]
    shape = planes.shape[:2]
    inverse, (count, shown) = np.empty(shape, np.float32), np.empty((2, *shape), np.uint8)
    geometry = stride_px, there, back, np.linalg.inv(camera.matrix), np.array(centres)
    limits = MAX_ERROR_PX, MAX_DEPTH_DIFFERENCE, math.radians(MIN_TRIANGULATION_DEG)
    made = inverse, count, shown
    parallel_for(len(planes), fuse_rows, planes, others, sizes[1:], *geometry, *limits, *made)

    row, column = np.nonzero(_agreed(planes, count, shown, stride_px))
    found, plane = maps[0][row, column], planes[row, column].astype(np.float64)
    xy, near = np.column_stack([column, row]) * float(stride_px), inverse[row, column]
    fused = np.empty(len(row), DENSE_POINT)
    fused["points"] = (camera.rays(xy) / near[:, None] - views[0].translation) @ views[0].rotation
    # The inverse depth of a plane at a pixel is (normal . line of sight) / (distance of the plane).
    ahead = near - (plane[:, 1:] * (xy - camera.centre)).sum(axis=1)
    away = np.column_stack([plane[:, 1:] * camera.focal_px, ahead]) @ views[0].rotation
    fused["normals"] = -away / np.linalg.norm(away, axis=1, keepdims=True)
    fused["errors"], fused["colors"] = found["error"], found["color"]
    fused["views"] = count[row, column]
    return fused


def _agreed(planes: np.ndarray, count: np.ndarray, shown: np.ndarray, stride_px: int) -> np.ndarray:
    """Return a mask of the pixels on which enough images agree.

    `count` (H, W) images agree on a pixel, and `shown` (H, W) images have its point in their frame.
    """
    from .dense_kernels import support_rows

    def support(chosen: np.ndarray, reach: int, spacing: int) -> np.ndarray:
        found = np.empty(chosen.shape, np.float32)
        square = reach, spacing, MAX_DEPTH_DIFFERENCE
        parallel_for(len(planes), support_rows, planes, stride_px, chosen, *square, found)
        return found

    def pixels(length_px: int) -> int:
        return max(1, length_px // stride_px)

    # Find the pixels on the near side of a depth edge. The dilation removes single far pixels.
    inverse, radius = planes[..., 0], pixels(EDGE_RADIUS_PX)
    known = cv2.dilate(np.where(inverse > 0, inverse, np.inf), np.ones((3, 3), np.uint8))
    farthest = cv2.erode(known, np.ones((2 * radius + 3,) * 2, np.uint8))
    slanted = radius * stride_px * np.abs(planes[..., 1:]).sum(axis=2)
    edge = inverse - farthest > MAX_DEPTH_DIFFERENCE * inverse + slanted
    agreed, spacing = count >= MIN_VIEWS, pixels(MIDDLE_SPACING_PX)
    middle = agreed & (support(agreed, 2 * spacing, spacing) >= MIN_MIDDLE_SHARE)
    filled = (count >= MIN_FILLED_VIEWS) & (support(middle, pixels(FILLED_RADIUS_PX), 1) > 0)
    return (filled & ~edge) | (count >= shown.clip(MIN_ALL_VIEWS, ENOUGH_VIEWS))


def merge_dense_points(parts: Iterable[tuple[PosedView, np.ndarray]], stride_px: int) -> np.ndarray:
    """Join the points of all reference images, but drop those that repeat points joined earlier."""
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
    """Return False if all corners (8, 3) of a box lie beyond one side of the widened frustum."""
    seen = (corners @ view.rotation.T + view.translation) @ view.camera.matrix.T
    xy, depth = seen[:, :2], seen[:, 2:]
    inside = [depth, xy + margin_px * depth, (np.array(view.camera.size) + margin_px) * depth - xy]
    return bool((np.hstack(inside) > 0).any(axis=0).all())


def nearest_depths(view: PosedView, parts: Sequence[np.ndarray], stride_px: int) -> np.ndarray:
    """Return the least depth of points in each square of `stride_px` in a view, else infinity."""
    columns, rows = (-(-side // stride_px) for side in view.camera.size)
    nearest = np.full((rows, columns), np.inf)
    for points in parts:
        projected, depth = view.project(points)
        cells = np.rint(np.where(depth[:, None] > 0, projected, -1e6) / stride_px)
        inside = ((cells >= 0) & (cells < (columns, rows))).all(axis=1)
        column, row = cells[inside].astype(np.int64).T
        np.minimum.at(nearest, (row, column), depth[inside])
    return nearest
