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

DEPTH_WEIGHT = 0.1
"""Of a difference in depth in that distance, against one across the line of sight: errors are along
it, and must not decide which points are near."""

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
    that the spacing of the points counts for nothing, and the distance is that along the line of
    sight from the nearest photograph, where the errors are. In pixels it is what the photograph
    sees of it that shows the point and the place on the plane farthest apart.

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
    points, others = np.asarray(points, np.float64), np.asarray(others, np.float64)
    depth, apart = np.full(len(points), np.nan), np.zeros(len(points))
    there = np.full(len(points), np.nan)
    seen = [_seen(view, points) for view in views]
    sizes = [own / view.camera.focal_px[0] for view, (_, own) in zip(views, seen, strict=True)]
    nearest = np.argmin(sizes, axis=0)  # the photograph that shows it largest
    for number, view in enumerate(views):
        rows = np.flatnonzero((nearest == number) & np.isfinite(sizes[number]))
        depth[rows] = seen[number][1][rows]
        there[rows] = _surface_depths(view, points[rows], others)
        on_surface = view.centre + (points[rows] - view.centre) * (there / depth)[rows, None]
        for other, (xy, _) in zip(views, seen, strict=True):
            distance = np.linalg.norm(other.project(on_surface)[0] - xy[rows], axis=1)
            apart[rows] = np.fmax(apart[rows], distance)  # NaN: the photograph does not show it
    covered = np.isfinite(there)
    if not covered.any():
        return CloudAgreement(len(points), 0.0, np.nan, np.nan, (0.0,) * len(AGREEMENT_PX))
    return CloudAgreement(
        len(points),
        float(covered.mean()),
        float(np.median(apart[covered])),
        float(np.median(np.abs(there / depth - 1)[covered])),
        tuple(float((apart[covered] <= limit).mean()) for limit in AGREEMENT_PX),
    )


def _surface_depths(view: PosedView, points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the depths (N,) at which lines of sight to points meet the surface of others.

    NaN where there are none near. The inverse depth of a plane is a linear function of the pixel:
    its least squares have no bias by errors along the line of sight, as those of distances from
    the plane would have.
    """
    from scipy.spatial import KDTree

    (places, own), (around, depth) = _seen(view, points), _seen(view, others)
    around, depth = around[np.isfinite(depth)], depth[np.isfinite(depth)]
    if not len(points) or len(depth) < PLANE_NEIGHBOURS:
        return np.full(len(points), np.nan)
    weight = DEPTH_WEIGHT * view.camera.focal_px[0]
    tree = KDTree(np.column_stack([around, weight * np.log(depth)]))
    distances, rows = tree.query(np.column_stack([places, weight * np.log(own)]), PLANE_NEIGHBOURS)
    offsets = around[rows] - places[:, None]
    terms = np.concatenate([np.ones((*rows.shape, 1)), offsets], axis=2)
    normal = np.einsum("nki,nkj->nij", terms, terms)
    # Neighbours on a line give the slope along it only.
    normal += np.diag([0, 1, 1]) * 1e-6 * np.einsum("nii->n", normal)[:, None, None]
    right = np.einsum("nki,nk->ni", terms, 1 / depth[rows])
    inverse = np.linalg.solve(normal, right[:, :, None])[:, 0, 0]
    near = (distances[:, 0] <= MAX_GAP_PX) & (inverse > 0)
    return np.where(near, 1 / np.where(near, inverse, 1), np.nan)


def _seen(view: PosedView, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions, NaN outside the image, and depths, infinite there."""
    xy, depth = view.project(points)
    inside = ((xy >= -0.5) & (xy <= np.array(view.camera.size) - 0.5)).all(axis=1) & (depth > 0)
    return np.where(inside[:, None], xy, np.nan), np.where(inside, depth, np.inf)
