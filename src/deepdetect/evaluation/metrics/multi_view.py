"""How far cameras of many photographs are from the true ones, and how far dense points agree."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...geometry.posed_view import PosedView
from .pose import rotation_error, translation_error

PLANE_NEIGHBOURS = 12
"""Points of the other set whose plane is taken for the surface there."""

MAX_GAP_PX = 6.0
"""From a point to the nearest of the other set, in pixels of the nearest photograph: further away
the other set has nothing there. Three times the usual stride."""

AGREEMENT_PX = (0.1, 0.25, 0.5, 1.0, 2.0)
"""Distances of which the share of points is reported."""


@dataclass(frozen=True, eq=False)
class CameraErrors:
    """How far cameras are from the true ones, after the alignment of their centres.

    Attributes:
        centres: (N,) distances from the true centres, in the unit of the truth.
        rotations_deg: (N,) angles from the true rotations.
        scale: the truth's unit over that of the cameras.
    """

    centres: np.ndarray
    rotations_deg: np.ndarray
    scale: float


def camera_errors(views: Sequence[PosedView], truth: Sequence[PosedView]) -> CameraErrors:
    """Compare cameras with the true ones, after a rotation, a shift and a scale.

    These are the ones that bring the centres nearest to the true ones (least squares; Umeyama,
    1991). Three cameras on a line leave a rotation about it open: so do those of a straight drive,
    whose rotations then have large errors.

    Args:
        views: the cameras, three or more.
        truth: the true ones, in the same order.

    Example:
        >>> from deepdetect.geometry.camera import Camera
        >>> camera = Camera((64, 48), 50.0)
        >>> at = lambda *centre: PosedView("", camera, np.eye(3), -np.array(centre, float))
        >>> found = camera_errors(
        ...     [at(0, 0, 0), at(1, 0, 0), at(0, 1, 0)], [at(5, 0, 0), at(7, 0, 0), at(5, 2, 0)]
        ... )
        >>> bool(np.allclose(found.centres, 0)), round(found.scale, 6)
        (True, 2.0)
    """
    own = np.array([view.centre for view in views])
    true = np.array([view.centre for view in truth])
    means = own.mean(axis=0), true.mean(axis=0)
    left, values, right = np.linalg.svd((true - means[1]).T @ (own - means[0]))
    signs = np.array([1, 1, np.sign(np.linalg.det(left @ right))])
    turn = left * signs @ right
    scale = float((values * signs).sum() / ((own - means[0]) ** 2).sum())
    placed = scale * (own - means[0]) @ turn.T + means[1]
    angles = [
        rotation_error(view.rotation @ turn.T, other.rotation)
        for view, other in zip(views, truth, strict=True)
    ]
    return CameraErrors(np.linalg.norm(placed - true, axis=1), np.array(angles), scale)


def relative_pose_errors(
    views: Mapping[str, PosedView], truth: Mapping[str, PosedView]
) -> list[float]:
    """Return the error of each pair's relative pose in degrees, for `pose_auc`.

    It is the larger of the angles of the rotation and between the directions of the translation;
    infinite where one of both cameras is missing. It needs no alignment.

    Args:
        views: the cameras by name; some may be missing.
        truth: all true ones.

    Example:
        >>> from deepdetect.geometry.camera import Camera
        >>> at = lambda x: PosedView("", Camera((64, 48), 50.0), np.eye(3), np.array([-x, 0, 0]))
        >>> truth = {"a": at(0.0), "b": at(1.0), "c": at(2.0)}
        >>> relative_pose_errors({"a": at(0.0), "b": at(5.0)}, truth)
        [0.0, inf, inf]
    """
    errors = []
    for pair in itertools.combinations(sorted(truth), 2):
        if not set(pair) <= set(views):
            errors.append(float("inf"))
            continue
        (rotation, translation), (true_rotation, true_translation) = (
            _relative_pose(cameras[pair[0]], cameras[pair[1]]) for cameras in (views, truth)
        )
        errors.append(
            max(
                rotation_error(rotation, true_rotation),
                translation_error(translation, true_translation),
            )
        )
    return errors


def _relative_pose(first: PosedView, second: PosedView) -> tuple[np.ndarray, np.ndarray]:
    rotation = second.rotation @ first.rotation.T
    return rotation, np.asarray(second.translation - rotation @ first.translation)


@dataclass(frozen=True)
class CloudAgreement:
    """How far the points of one set are from the surface of another one.

    Attributes:
        points: number of points.
        covered: fraction of them where the other set has points, within `MAX_GAP_PX`.
        median_px: of these the median distance as photographs see it.
        median_depth_ratio: the median of the distance over the depth in the nearest photograph.
        within: fraction of the covered points up to each of `AGREEMENT_PX`.
    """

    points: int
    covered: float
    median_px: float
    median_depth_ratio: float
    within: tuple[float, ...]


def cloud_agreement(
    points: np.ndarray, others: np.ndarray, views: Sequence[PosedView]
) -> CloudAgreement:
    """Measure how far points are from the surface through the points of another set.

    Two sets that were made from different photographs have independent errors of matching. The
    surface at a point is the plane of the `PLANE_NEIGHBOURS` nearest points of the other set, so
    that the spacing of the points counts for nothing. The distance from it along its normal is also
    given in pixels: how far the point and its foot on the plane are apart in the photograph that
    shows them farthest apart.

    What both sets have in common is not seen: errors of the poses, or edges that are too wide in
    both. A point more than `MAX_GAP_PX` from the other set is not covered, and has no distance: the
    share of these holds what only one set could match, and gross errors. Compare two methods by
    both numbers.

    Args:
        points, others: (N, 3) and (M, 3).
        views: the cameras.

    Example:
        >>> from deepdetect.geometry.camera import Camera
        >>> y, x = np.mgrid[-1:1:20j, -1:1:20j].reshape(2, -1)
        >>> plane = np.column_stack([x, y, np.full_like(x, 10)])
        >>> view = PosedView("", Camera((200, 200), 500.0), np.eye(3), np.zeros(3))
        >>> found = cloud_agreement(plane, plane + [0.02, 0.01, 0.05], [view])
        >>> round(found.median_depth_ratio, 6), found.covered
        (0.005, 1.0)
    """
    from scipy.spatial import KDTree

    if not len(points) or len(others) < PLANE_NEIGHBOURS or not views:
        nothing = float("nan")
        return CloudAgreement(len(points), 0.0, nothing, nothing, (0.0,) * len(AGREEMENT_PX))
    points, others = np.asarray(points, np.float64), np.asarray(others, np.float64)
    distances, nearest = KDTree(others).query(points, PLANE_NEIGHBOURS)
    projected = [_seen(view, points) for view in views]
    footprint = np.min(
        [
            depth / view.camera.focal_px[0]
            for view, (_, depth) in zip(views, projected, strict=True)
        ],
        axis=0,
    )
    depth = np.min([depth for _, depth in projected], axis=0)
    covered = np.flatnonzero(distances[:, 0] <= MAX_GAP_PX * footprint)
    if not len(covered):
        nothing = float("nan")
        return CloudAgreement(len(points), 0.0, nothing, nothing, (0.0,) * len(AGREEMENT_PX))
    near = others[nearest[covered]]
    middle = near.mean(axis=1)
    centred = near - middle[:, None]
    _, directions = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))
    normal = directions[:, :, 0]
    offset = np.einsum("ij,ij->i", points[covered] - middle, normal)
    foot = points[covered] - offset[:, None] * normal
    apart = np.zeros(len(covered))
    for view, (xy, _) in zip(views, projected, strict=True):
        there, _ = _seen(view, foot)
        distance = np.linalg.norm(xy[covered] - there, axis=1)
        apart = np.fmax(apart, distance)  # NaN where the photograph does not show it
    return CloudAgreement(
        len(points),
        len(covered) / len(points),
        float(np.median(apart)),
        float(np.median(np.abs(offset) / depth[covered])),
        tuple(float((apart <= limit).mean()) for limit in AGREEMENT_PX),
    )


def _seen(view: PosedView, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions, NaN outside the image, and depths, infinite there."""
    xy, depth = view.project(points)
    inside = ((xy >= -0.5) & (xy <= np.array(view.camera.size) - 0.5)).all(axis=1) & (depth > 0)
    return np.where(inside[:, None], xy, np.nan), np.where(inside, depth, np.inf)
