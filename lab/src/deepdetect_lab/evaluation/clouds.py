"""Render point clouds from any viewpoint, without a display."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from deepdetect._shared.opencv import cv2
from deepdetect.geometry.camera import Camera, PosedView
from deepdetect.geometry.point_cloud import (
    BOX_PERCENTILE,
    PointCloud,
    angular_spacing,
    require_points,
    robust_box,
)
from deepdetect.viz.draw import add_caption, join_pictures

SUPERSAMPLING = 2
"""Each pixel is the mean of 2x2 rendered pixels, so that edges are smooth."""

FILL_RATIO = 0.95
"""The cloud fills this fraction of the figure, so that a small margin is left."""

POINT_OVERLAP = 1.4
"""Points are drawn wider than their spacing by this factor, since side views would show gaps."""

MAX_POINT_WIDTH_PX = 5
"""Points have at most this width, so that a sparse cloud looks sparse."""


def orbit_camera(
    cloud: PointCloud,
    azimuth: float = 12.0,
    elevation: float = 8.0,
    size: tuple[int, int] = (800, 600),
) -> PosedView:
    """Place a camera that looks at the robust centre of a cloud and sees all of it.

    The camera is as far from the centre as the left camera, so small angles give a view like the
    photograph. The azimuth moves it to the right; the elevation moves it up (90: it looks down).
    """
    a, e = np.deg2rad([azimuth, elevation])
    right = [np.cos(a), 0, np.sin(a)]
    down = [np.sin(e) * np.sin(a), np.cos(e), -np.sin(e) * np.cos(a)]
    forward = [-np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)]
    axes = np.array([right, down, forward])
    box = robust_box(cloud)
    distance = max(float(np.linalg.norm(box.centre)), box.radius)
    translation = distance * np.array([0, 0, 1.0]) - axes @ box.centre
    # A camera with focal length 1 and principal point 0 shows the extent of the cloud.
    plain = PosedView("", Camera(size, 1.0, (0, 0)), axes, translation)
    xy, depth = plain.project(cloud.points)
    low, high = np.percentile(xy[depth > 0], (BOX_PERCENTILE, 100 - BOX_PERCENTILE), axis=0)
    wanted = FILL_RATIO * np.array(size) / np.maximum(high - low, 1e-6)
    focal = float(wanted.min())
    centre = ((np.array(size) - 1) / 2 - focal * (low + high) / 2).tolist()
    return replace(plain, camera=Camera(size, focal, centre))


def render(cloud: PointCloud, camera: PosedView) -> np.ndarray:
    """Render a cloud on white, (H, W, 3) uint8; each point is a square that hides those behind it.

    Squares are wide enough to close a surface at the points' spacing and depth.
    """
    require_points(cloud)
    width, height = camera.camera.size
    fine_camera = camera.camera.scaled((width * SUPERSAMPLING, height * SUPERSAMPLING))
    nearest = _nearest_points(cloud, replace(camera, camera=fine_camera))
    # Pixels that show no point have index -1: the last colour, white.
    colors = np.append(cloud.colors, np.full((1, 3), 255, np.uint8), axis=0)
    return cv2.resize(colors[nearest], (width, height), interpolation=cv2.INTER_AREA)


def draw_clouds(left: np.ndarray, clouds: Mapping[str, PointCloud], width: int = 796) -> np.ndarray:
    """Draw the left image and clouds by title in a grid of two columns.

    The clouds are in the left camera's frame, in one unit. One camera shows them all; its pose
    depends on the cloud with the most points.
    """
    size = (width, max(1, round(width * left.shape[0] / left.shape[1])))
    shrinks = left.shape[1] > width
    image = cv2.resize(left, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
    panels = [add_caption(image, "left image")]
    camera = orbit_camera(max(clouds.values(), key=len), size=size)
    for title, cloud in clouds.items():
        # A method without points has a white panel.
        empty = np.full((size[1], size[0], 3), 255, np.uint8)
        drawn = render(cloud, camera) if len(cloud) else empty
        panels.append(add_caption(drawn, f"{title}: {len(cloud):,} points"))
    return join_pictures(panels, 2)


def _nearest_points(cloud: PointCloud, camera: PosedView) -> np.ndarray:
    """Return the index of the point that each pixel shows, (H, W) int64; -1: no point."""
    width, height = camera.camera.size
    xy, depth = camera.project(cloud.points)
    spread = camera.camera.focal_px[0] * POINT_OVERLAP * angular_spacing(cloud)
    sides = spread * np.maximum(cloud.points[:, 2], 0) / np.where(depth > 0, depth, np.inf)
    sides = np.clip(np.rint(sides), 1, MAX_POINT_WIDTH_PX * SUPERSAMPLING).astype(np.int64)
    corners = np.rint(xy - (sides[:, None] - 1) / 2)
    visible = (depth > 0) & (corners > -sides[:, None]).all(1) & (corners < (width, height)).all(1)
    # Points are ranked by depth: a pixel shows the point of the smallest rank.
    order = np.flatnonzero(visible)
    order = order[np.argsort(depth[order].astype(np.float32), kind="stable")]
    sides, corners = sides[order], corners[order].astype(np.int64)
    nearest = np.full(width * height, len(order))
    for across, down in np.ndindex(2 * (int(sides.max(initial=0)),)):
        rank = np.flatnonzero(sides > max(across, down))
        column, row = (corners[rank] + (across, down)).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        np.minimum.at(nearest, row[inside] * width + column[inside], rank[inside])
    return np.append(order, -1)[nearest].reshape(height, width)
