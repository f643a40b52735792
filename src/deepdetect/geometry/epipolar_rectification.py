"""Rectify two views by their fundamental matrix, so that epipolar lines become rows.

`PlanarFrame` warps each view by a homography (Hartley, "Theory and practice of projective
rectification", 1999). This suits cameras side by side. `PolarFrame` has one row for each direction
from the epipole (Pollefeys, Koch and Van Gool, "A simple and efficient rectification method for
general motion", 1999). It also works if the epipole lies in the image. Its columns are spaced by
the logarithm of the distance from the epipole, so that the magnification by a forward motion
becomes a shift of columns.

In both frames the match of (x, y) in the first rectified view is (x - disparity, y) in the second.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .._shared.opencv import cv2
from .camera import Size
from .transforms import homography_derivatives, transform_points, translation_matrix

Both = tuple[np.ndarray, np.ndarray]

MAX_STRETCH = 2.0
"""A planar frame may enlarge or reduce a part of a view by at most this factor, relative to the
scale at the median match. Scales are measured parallel to the line mapped to infinity. Other views
get a polar frame. Chosen on pairs of Oxford, Middlebury, Strecha's fountain and KITTI."""

MAX_AREA = 3.0
"""Maximum area of a planar frame, as a multiple of the larger view's. Chosen like `MAX_STRETCH`."""

RESOLVED_QUANTILE = 0.6
"""The resolution of a polar frame falls with the distance from the epipole. It equals the first
view's at this quantile of the distances of the view's pixels. Chosen like `MAX_STRETCH`."""

MIN_RADIUS_PX = 8.0
"""A polar frame leaves out pixels nearer to the epipole than this, because hardly anything moves
there. Chosen like `MAX_STRETCH`."""

MAX_SIDE_PX = 2**15 - 2
"""Maximum width and height of a frame, because OpenCV cannot warp to a larger one."""


@dataclass(frozen=True, eq=False)
class PlanarFrame:
    """A frame to which each of two views is rectified by a homography.

    `homographies` are the (3, 3) matrices that map the pixels of each view to the frame, and `size`
    is the (width, height) of the frame. In the methods, `view` is 0 for the first view and 1 for
    the second. Parts of a view beyond the line that its homography maps to infinity are not shown.
    """

    homographies: tuple[np.ndarray, np.ndarray]
    size: Size

    def to_frame(self, points: np.ndarray, view: int) -> np.ndarray:
        """Map (N, 2) positions of a view to the frame, (N, 2) float64."""
        return transform_points(points, self.homographies[view])

    def from_frame(self, points: np.ndarray, view: int) -> np.ndarray:
        """Map (N, 2) positions of the frame to a view, (N, 2) float64."""
        return transform_points(points, np.linalg.inv(self.homographies[view]))

    def warp(self, image: np.ndarray, view: int) -> tuple[np.ndarray, np.ndarray]:
        """Warp a view into the frame; return the image and the (H, W) bool mask of valid pixels."""
        matrix = self.homographies[view]
        whole = np.full(image.shape[:2], 255, np.uint8)
        shown = cv2.warpPerspective(whole, matrix, self.size, flags=cv2.INTER_NEAREST) > 0
        # This sign makes `inverse[2] @ (x, y, 1)` positive on the visible side of the horizon.
        inverse = np.linalg.inv(matrix) * np.linalg.det(matrix)
        x, y = (np.arange(length) for length in self.size)
        shown &= inverse[2, 0] * x + inverse[2, 1] * y[:, None] + inverse[2, 2] > 0
        return cv2.warpPerspective(image, matrix, self.size, flags=cv2.INTER_LANCZOS4), shown


@dataclass(frozen=True, eq=False)
class PolarFrame:
    """A frame to which two views are rectified about their epipoles, in polar coordinates.

    The methods are those of `PlanarFrame`. Rows are angles about the epipole of the first view, in
    radians, and columns are distances from it. The first row has the angle `middle` +
    `first_angle`, and the angle grows by `step` per row. The first column has the distance
    `min_radius_px`, and the natural logarithm of the distance grows by `step` per column. `middle`
    is the direction of the view's centre, or 0 if the epipole lies in the view. `orientation`, 1 or
    -1, selects a half of each epipolar line in the second view. If a homography `plane` from the
    first view to the second is given, its inverse first warps the second view.
    """

    fundamental: np.ndarray
    epipoles: tuple[np.ndarray, np.ndarray]
    orientation: float
    middle: float
    first_angle: float
    step: float
    min_radius_px: float
    size: Size
    plane: np.ndarray | None = None

    def to_frame(self, points: np.ndarray, view: int) -> np.ndarray:
        """Map (N, 2) positions of a view to the frame; the epipole is mapped to infinity."""
        if view and self.plane is not None:
            points = transform_points(points, np.linalg.inv(self.plane))
        offset = np.asarray(points, np.float64).reshape(-1, 2) - self.epipoles[view]
        angle = np.arctan2(offset[:, 1], offset[:, 0])
        if view:  # the angle in the first view of the epipolar line on which the point lies
            lines = np.column_stack([points, np.ones(len(offset))]) @ self.fundamental
            angle = np.arctan2(-lines[:, 0], lines[:, 1])
            same = (self._directions(angle, 1) * offset).sum(axis=1) > 0
            angle = np.where(same, angle, angle + np.pi)
        relative = (angle - self.middle + np.pi) % (2 * np.pi) - np.pi
        with np.errstate(divide="ignore"):
            radius = np.log(np.hypot(*offset.T) / self.min_radius_px)
        return np.column_stack([radius, relative - self.first_angle]) / self.step

    def from_frame(self, points: np.ndarray, view: int) -> np.ndarray:
        """Map (N, 2) positions of the frame to a view."""
        column, row = np.asarray(points, np.float64).reshape(-1, 2).T
        return self._positions(column, row, view)

    def warp(self, image: np.ndarray, view: int) -> tuple[np.ndarray, np.ndarray]:
        """Warp a view into the frame; return the image and the (H, W) bool mask of valid pixels."""
        width, height = self.size
        column, row = np.arange(width, dtype=np.float32)[None], np.arange(height)[:, None]
        places = self._positions(column, row, view)
        last = np.array(image.shape[1::-1], np.float32) - 0.5
        shown = np.all((places >= -0.5) & (places <= last), axis=2)
        border = cv2.BORDER_REPLICATE
        return cv2.remap(image, places, None, cv2.INTER_LANCZOS4, borderMode=border), shown

    def _positions(self, column: np.ndarray, row: np.ndarray, view: int) -> np.ndarray:
        """Map columns and rows of the frame, broadcast together, to (..., 2) view positions."""
        angles = self.middle + self.first_angle + row * self.step
        origin, along = self.epipoles[view], self._directions(angles.ravel(), view)
        matrix = np.eye(3) if not view or self.plane is None else self.plane
        radius = self.min_radius_px * np.exp(column * self.step)
        # A homography maps e + r d, r times the direction d from the epipole e, to He + r Hd.
        starts, slopes = matrix @ (*origin, 1.0), (along @ matrix[:, :2].T).astype(radius.dtype)
        x, y, z = (
            start + slope.reshape(row.shape) * radius
            for start, slope in zip(starts.tolist(), slopes.T, strict=True)
        )
        with np.errstate(divide="ignore", invalid="ignore"):  # points at infinity
            return np.stack([x / z, y / z], axis=-1)

    def _directions(self, angles: np.ndarray, view: int) -> np.ndarray:
        first = np.column_stack([np.cos(angles), np.sin(angles)])
        if not view:
            return first
        # A direction from the first epipole has one epipolar line: that of its point at infinity.
        lines = first @ self.fundamental[:, :2].T
        along = self.orientation * np.column_stack([lines[:, 1], -lines[:, 0]])
        return along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)


RectifiedFrame = PlanarFrame | PolarFrame


def rectified_frame(
    points0: np.ndarray,
    points1: np.ndarray,
    fundamental: np.ndarray,
    size0: Size,
    size1: Size,
    plane: np.ndarray | None = None,
) -> RectifiedFrame | None:
    """Choose a frame in which (N, 2) matches that fit a fundamental matrix lie on rows.

    The frame is planar if that distorts the views little, otherwise polar. The result is None if
    neither is possible or there are fewer than eight matches. Sizes are (width, height). `plane`
    may be the homography of a plane in the scene, from the first view to the second. Its inverse
    first warps the second view, which removes the slant of the plane.
    """
    if plane is not None:
        shown = transform_points(points1, np.linalg.inv(plane))
        frame = rectified_frame(points0, shown, plane.T @ fundamental, size0, size0)
        if not isinstance(frame, PlanarFrame):
            return frame and replace(frame, plane=plane)
        first, second = frame.homographies
        return replace(frame, homographies=(first, second @ np.linalg.inv(plane)))
    points = np.asarray(points0, np.float64), np.asarray(points1, np.float64)
    if len(points0) < 8:
        return None
    sizes = size0, size1
    frame = _planar_frame(points, fundamental, sizes) or _polar_frame(points, fundamental, sizes)
    return None if frame is None or max(frame.size) > MAX_SIDE_PX else frame


def _planar_frame(
    points: Both, fundamental: np.ndarray, sizes: tuple[Size, Size]
) -> PlanarFrame | None:
    """Rectify by homographies, or return None if they distort too much."""
    success, *matrices = cv2.stereoRectifyUncalibrated(*points, fundamental, sizes[0], threshold=0)
    if not success or not all(np.isfinite(matrix).all() for matrix in matrices):
        return None
    corners = [_corners(size) for size in sizes]
    middles = [np.median(of_view, axis=0) for of_view in points]
    for matrix, border, middle in zip(matrices, corners, middles, strict=True):
        depth = (border @ matrix[2, :2] + matrix[2, 2]) / (middle @ matrix[2, :2] + matrix[2, 2])
        if depth.min() <= 0 or max(depth.max(), 1 / depth.min()) > MAX_STRETCH:
            return None
    jacobians = [
        homography_derivatives(np.array([middle]), matrix)[0]
        for matrix, middle in zip(matrices, middles, strict=True)
    ]
    areas = np.linalg.det(jacobians)
    if areas.min() <= 0:
        return None
    scale = 1 / np.sqrt(areas[0])  # the first view keeps its scale
    if jacobians[0][0, 0] < 0:  # the first view would be upside down
        scale = -scale
    first, second = (np.diag([scale, scale, 1]) @ matrix for matrix in matrices)
    moved = transform_points(points[0], first) - transform_points(points[1], second)
    second = translation_matrix(np.round(np.median(moved[:, 0])), 0) @ second
    borders = np.stack([transform_points(corners[0], first), transform_points(corners[1], second)])
    (left, _), (right, _) = borders.min(axis=(0, 1)), borders.max(axis=(0, 1))
    top, bottom = borders[..., 1].min(axis=1).max(), borders[..., 1].max(axis=1).min()
    width, height = int(np.ceil(right - left)) + 1, int(np.ceil(bottom - top)) + 1
    if height < 2 or width * height > MAX_AREA * np.prod(sizes, axis=1).max():
        return None
    shift = translation_matrix(-np.floor(left), -np.floor(top))
    return PlanarFrame((shift @ first, shift @ second), (width, height))


def _polar_frame(
    points: Both, fundamental: np.ndarray, sizes: tuple[Size, Size]
) -> PolarFrame | None:
    """Rectify about the epipoles, or return None if one of them lies at infinity."""
    left, _, right = np.linalg.svd(fundamental)
    if min(abs(right[2, 2]), abs(left[2, 2])) < 1e-12:
        return None
    epipoles = right[2, :2] / right[2, 2], left[:2, 2] / left[2, 2]
    border = _corners(sizes[0]) - epipoles[0]
    wrapped = bool(((epipoles[0] > 0) & (epipoles[0] < np.array(sizes[0]) - 1)).all())
    middle, first_angle, last_angle = 0.0, -np.pi, np.pi
    if not wrapped:
        centre = border.mean(axis=0)
        middle = float(np.arctan2(centre[1], centre[0]))
        angles = np.arctan2(border[:, 1], border[:, 0]) - middle
        relative = (angles + np.pi) % (2 * np.pi) - np.pi
        first_angle, last_angle = float(relative.min()), float(relative.max())
    width, height = sizes[0]
    pixels = np.mgrid[0:width:16, 0:height:16].reshape(2, -1).T - epipoles[0]
    radii = np.hypot(*pixels.T)
    step = 1 / max(float(np.quantile(radii, RESOLVED_QUANTILE)), 1.0)
    farthest = max(
        np.hypot(*(_corners(size) - epipole).T).max()
        for size, epipole in zip(sizes, epipoles, strict=True)
    )
    nearest = MIN_RADIUS_PX if wrapped else max(float(radii.min()), MIN_RADIUS_PX)
    width = int(np.ceil(np.log(farthest / nearest) / step)) + 1
    size = width, int(np.ceil((last_angle - first_angle) / step)) + 1
    frame = PolarFrame(fundamental, epipoles, 1.0, middle, first_angle, step, nearest, size)
    # The orientation is that of the half-lines on which most of the matches lie.
    angles = np.arctan2(*(points[0] - epipoles[0]).T[::-1])
    along = (frame._directions(angles, 1) * (points[1] - epipoles[1])).sum(axis=1)
    return frame if np.median(np.sign(along)) >= 0 else replace(frame, orientation=-1.0)


def _corners(size: Size) -> np.ndarray:
    right, bottom = size[0] - 1, size[1] - 1
    return np.array([[0, 0], [right, 0], [right, bottom], [0, bottom]], np.float64)
