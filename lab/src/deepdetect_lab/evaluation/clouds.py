"""Pictures of point clouds from any side, by matplotlib."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from deepdetect._shared.opencv import cv2
from deepdetect.geometry.point_cloud import PointCloud, robust_box
from deepdetect.viz.draw import add_caption, join_pictures

DPI = 100
"""Pixels to an inch, in which matplotlib counts."""

POINT_AREA = 1.5
"""Area of a drawn point, in units of (1/72 inch)^2. It is 1.7 pixels wide, so that a surface with
one point per image pixel has no gaps in side views."""

ZOOM = 2.2
"""Zoom of the plot; at 1 the robust box of a cloud fills less than half of the figure's width."""


def draw_cloud(
    cloud: PointCloud,
    azimuth: float = 12.0,
    elevation: float = 8.0,
    size: tuple[int, int] = (800, 600),
    like: PointCloud | None = None,
) -> np.ndarray:
    """Draw a cloud on white, (H, W, 3) uint8; near points hide far ones.

    It is seen from the right (azimuth) and from above (elevation), in degrees; the robust box of
    another cloud, or its own, fills the picture.
    """
    figure = Figure((size[0] / DPI, size[1] / DPI), DPI)
    canvas: Any = FigureCanvasAgg(figure)
    axes: Any = figure.add_axes((0, 0, 1, 1), projection="3d")
    box = robust_box(cloud if like is None else like)
    right, down, ahead = cloud.points.T
    colors = cloud.colors / 255
    axes.scatter(
        right, ahead, -down, c=colors, s=POINT_AREA, marker="s", linewidths=0, depthshade=False
    )
    x, y, z = box.centre
    limits = ((middle - box.radius, middle + box.radius) for middle in (x, z, -y))
    axes.set(**dict(zip(("xlim", "ylim", "zlim"), limits, strict=True)))
    axes.set_box_aspect((1, 1, 1), zoom=ZOOM)
    axes.view_init(elevation, azimuth - 90)
    axes.set_axis_off()
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def draw_clouds(left: np.ndarray, clouds: Mapping[str, PointCloud], width: int = 796) -> np.ndarray:
    """Draw the left image and clouds by title in a grid of two columns.

    All are seen from one place, which the one with the most points decides.
    """
    size = (width, max(1, round(width * left.shape[0] / left.shape[1])))
    shrinks = left.shape[1] > width
    image = cv2.resize(left, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
    panels = [add_caption(image, "left image")]
    largest = max(clouds.values(), key=len)
    for title, cloud in clouds.items():
        drawn = draw_cloud(cloud, size=size, like=largest)
        panels.append(add_caption(drawn, f"{title}: {len(cloud):,} points"))
    return join_pictures(panels, 2)
