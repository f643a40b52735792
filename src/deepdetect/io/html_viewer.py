"""An interactive viewer of a point cloud as one self-contained HTML page.

The page's template is `viewer.html` in this folder: plain JavaScript and WebGL 1.
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib import resources
from itertools import pairwise
from pathlib import Path

import numpy as np

from ..geometry.camera import PosedView, camera_spacing
from ..geometry.point_cloud import UNITS, PointCloud, RobustBox, angular_spacing, robust_box

DEFAULT_SLOPE, SLOPES = 0.35, (0.05, 3.0)
"""The page's field of view is given by the tangent of half its angle: a value in the range SLOPES
that fits the points, or DEFAULT_SLOPE if none has z > 0. Chosen by hand."""

MAX_LEVEL, MARGIN = 65535, 1.0
"""Positions along each axis are stored as integers from 0 to MAX_LEVEL, in 16 bits. Points outside
the robust box by more than MARGIN times its size are left out, because a few distant points would
make the steps coarse. Chosen by hand."""

CAMERA_SIZE = 0.35
"""Depth of the pyramids that stand for cameras, relative to the median distance from a camera to
the nearest other camera. Chosen by hand."""

OVERVIEW_RADIANS, OVERVIEW_POINTS = (0.4, 0.5), 2000
"""OVERVIEW_RADIANS are azimuth and elevation of the first view of a page with cameras. The view is
fitted to about OVERVIEW_POINTS points, which saves time. Chosen by hand."""


@dataclass(frozen=True, eq=False)
class PagePoints:
    """Points as the page stores them: (N, 3) uint16 levels and (N, 3) uint8 colours.

    The positions of the points are `offset + levels * step`, where `offset` and `step` have shape
    (3,). `left_out` is the number of points that are too far away to be stored.
    """

    levels: np.ndarray
    colors: np.ndarray
    offset: np.ndarray
    step: np.ndarray
    left_out: int


def write_html_page(
    cloud: PointCloud, path: Path, metadata: Mapping[str, str], cameras: Sequence[PosedView] = ()
) -> None:
    """Write the page: 12 bytes per point, as 16-bit positions and 8-bit colours in base64.

    The metadata are added to the caption, which states the counts, the unit and the precision;
    the entry "title" becomes the heading. Cameras are drawn as pyramids, connected by lines.
    """
    stored = page_points(cloud)
    precision = f"{stored.step.max() / 2:.2g} {UNITS[cloud.unit].split()[0]}"
    caption = {
        "Points": f"{len(stored.levels):,}",
        **({"Left out, far away": f"{stored.left_out:,}"} if stored.left_out else {}),
        "Unit": UNITS[cloud.unit],
        "Positions to": f"{precision} (16 bits per axis)",
        **{name: text for name, text in metadata.items() if name != "title"},
    }
    values = {
        "title": escape(metadata.get("title", "Point cloud")),
        "caption": "\n".join(
            f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>" for name, text in caption.items()
        ),
        "cloud": json.dumps(_description(cloud, stored, cameras)),  # no user text to escape
        "positions": _base64(stored.levels.astype("<u2")),
        "colors": _base64(stored.colors),
    }
    template = resources.files(__package__).joinpath("viewer.html").read_text("utf-8")
    # One pass fills in all values, so that placeholders within the metadata stay as they are.
    page = re.sub(r"\{\{(\w+)\}\}", lambda mark: values[mark[1]], template)
    path.write_text(page, encoding="utf-8")


def page_points(cloud: PointCloud) -> PagePoints:
    """Quantise positions to 16 bits per axis; leave out points far outside the robust box."""
    box = robust_box(cloud)
    # Points on a line or a plane have a flat box, so its radius sets the smallest margin.
    margin = MARGIN * np.maximum(box.high - box.low, box.radius * 1e-3)
    near = ((cloud.points >= box.low - margin) & (cloud.points <= box.high + margin)).all(1)
    points = cloud.points[near].astype(np.float64)
    low, high = points.min(0), points.max(0)
    step = np.where(high > low, (high - low) / MAX_LEVEL, 1.0)
    levels = np.rint((points - low) / step).astype(np.uint16)
    return PagePoints(levels, cloud.colors[near], low, step, int((~near).sum()))


def camera_lines(cameras: Sequence[PosedView]) -> np.ndarray:
    """Return the end points (N, 2, 3) of lines that draw cameras and the path between them."""
    if not len(cameras):
        return np.empty((0, 2, 3))
    centres = np.array([camera.centre for camera in cameras])
    spacing = camera_spacing(centres) if len(cameras) > 1 else 1.0
    lines = []
    for camera, centre in zip(cameras, centres, strict=True):
        corners = camera.corners(CAMERA_SIZE * spacing)
        lines += [(centre, corner) for corner in corners]
        lines += [(corners[k - 1], corners[k]) for k in range(4)]
    lines += list(pairwise(centres))
    return np.array(lines) + 0.0  # no negative zeros


def _description(
    cloud: PointCloud, stored: PagePoints, cameras: Sequence[PosedView]
) -> dict[str, object]:
    box = robust_box(cloud)
    corners = np.stack([stored.offset, stored.offset + MAX_LEVEL * stored.step])
    reach = np.linalg.norm(np.abs(corners - box.centre).max(0))
    lines = camera_lines(cameras).reshape(-1, 3)
    if len(lines):
        reach = max(reach, np.linalg.norm(lines - box.centre, axis=1).max())
    slope = _largest_slope(cloud)
    return {
        "count": len(stored.levels),
        "unit": cloud.unit,
        "offset": stored.offset.tolist(),
        "step": stored.step.tolist(),
        "centre": box.centre.tolist(),
        "radius": box.radius,
        "reach": float(reach),
        "spacing": angular_spacing(cloud),
        "slope": slope,
        "view": _overview(cloud, box, lines, slope) if len(lines) else None,
        "lines": lines.round(6).ravel().tolist(),
    }


def _overview(
    cloud: PointCloud, box: RobustBox, lines: np.ndarray, slope: float
) -> dict[str, object]:
    """Return the closest view from behind and above the cameras that shows them and the cloud."""
    inside = ((cloud.points >= box.low) & (cloud.points <= box.high)).all(axis=1)
    near = cloud.points[inside][:: max(1, int(inside.sum()) // OVERVIEW_POINTS)]
    shown = np.concatenate([near.astype(np.float64), lines])
    (c, s), (d, t) = ((np.cos(angle), np.sin(angle)) for angle in OVERVIEW_RADIANS)
    axes = np.array([[c, 0, s], [t * s, d, -t * c], [-d * s, t, d * c]])  # turns as in viewer.html
    seen = shown @ axes.T
    # A point is visible if both |x - x0| and |y - y0| are below slope * (z + distance).
    right, left = ((sign * seen[:, :2] - slope * seen[:, 2:]).max(axis=0) for sign in (1, -1))
    across = (right - left) / 2
    depth = np.median(near @ axes[2])
    distance = float((right + left).max() / 2 / slope + depth)
    return {
        "azimuth": OVERVIEW_RADIANS[0],
        "elevation": OVERVIEW_RADIANS[1],
        "distance": max(1.05 * distance, box.radius * 1e-3),
        "target": (np.array([*across, depth]) @ axes).tolist(),
    }


def _largest_slope(cloud: PointCloud) -> float:
    """Return the slope (see `SLOPES`) at which a camera at the origin sees 99% of the points."""
    before = cloud.points[cloud.points[:, 2] > 0].astype(np.float64)
    if not len(before):
        return DEFAULT_SLOPE
    slopes = np.abs(before[:, :2] / before[:, 2:]).max(1)
    return float(np.clip(1.05 * np.percentile(slopes, 99), *SLOPES))


def _base64(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")
