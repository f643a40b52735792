"""Draw point clouds from any direction with matplotlib."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from deepdetect._shared.opencv import cv2
from deepdetect.geometry.point_cloud import PointCloud, robust_box
from deepdetect.viz.draw import add_caption

from ..labels.fusion import join_pictures

DPI = 100
"""Pixels per inch of the figure. It is needed because matplotlib takes sizes in inches."""

POINT_AREA = 1.5
"""Area of a drawn point in matplotlib's unit, (1/72 inch)^2. The point is 1.7 pixels wide, so that
a surface with one point per image pixel has no gaps when it is seen from the side."""

ZOOM = 2.2
"""Zoom of the plot. At 1, the box around a cloud would fill less than half the figure's width."""


def draw_cloud(
    cloud: PointCloud,
    azimuth: float = 12.0,
    elevation: float = 8.0,
    size: tuple[int, int] = (800, 600),
    like: PointCloud | None = None,
) -> np.ndarray:
    """Draw a point cloud on white; return an (H, W, 3) uint8 image. Near points hide far ones.

    The viewpoint is that of the camera, moved around the cloud to the right by the azimuth and up
    by the elevation, in degrees. The image shows the box around the cloud without its outliers. If
    another cloud is given as `like`, the image shows that cloud's box instead.
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
    """Draw the left image and each cloud with its title in a grid of two columns.

    All clouds are drawn from the same viewpoint, framed by the box of the cloud with most points.
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
