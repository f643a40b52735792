"""Clouds of one scene side by side, as the paper's Figure 8."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from .._shared.errors import OptionError
from ..geometry.point_cloud import PointCloud
from .draw import side_by_side, stacked, with_caption
from .render import camera_around, render


def draw_clouds(
    left: np.ndarray,
    clouds: Mapping[str, PointCloud],
    azimuth: float = 12.0,
    elevation: float = 8.0,
    width: int = 796,
    columns: int = 2,
) -> np.ndarray:
    """Draw the left image and the clouds made from it, all seen by one camera.

    Args:
        left: (H, W, 3) uint8 RGB, the left image.
        clouds: by title; the one with the most points decides where the camera stands. All
            are in the frame of the left camera and in one unit.
        azimuth, elevation: degrees, as of `camera_around`.
        width: of a panel in pixels.
        columns: panels a row.

    Returns:
        (H', W', 3) uint8 RGB: rows of panels, each with its title and its count below.

    Raises:
        OptionError: there is no cloud with a point, or their units differ.

    Example:
        >>> left = np.zeros((30, 40, 3), np.uint8)
        >>> cloud = PointCloud([[0.0, 0.0, 5.0], [1.0, 1.0, 6.0]], left[0, :2], "mm")
        >>> draw_clouds(left, {"ours": cloud}, width=80).shape
        (88, 166, 3)
    """
    if not any(map(len, clouds.values())):
        raise OptionError("no cloud has a point: there is nothing to draw")
    if len({cloud.unit for cloud in clouds.values()}) > 1:
        raise OptionError("clouds in one figure must have one unit: make them with one calibration")
    size = (width, max(1, round(width * left.shape[0] / left.shape[1])))
    shrinks = width < left.shape[1]
    image = cv2.resize(left, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
    panels = [with_caption(image, "left image")]
    camera = camera_around(max(clouds.values(), key=len), azimuth, elevation, size)
    for title, cloud in clouds.items():
        # Without points there is a white panel, which is what a method that finds none shows.
        empty = np.full((size[1], size[0], 3), 255, np.uint8)
        drawn = render(cloud, camera) if len(cloud) else empty
        panels.append(with_caption(drawn, f"{title}: {len(cloud):,} points"))
    rows = [panels[k : k + columns] for k in range(0, len(panels), columns)]
    return stacked([side_by_side(row) for row in rows])
