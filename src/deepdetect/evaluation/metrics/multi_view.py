"""How far cameras of many images are from the true ones."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...geometry.camera import PosedView
from .pose import rotation_error, translation_error


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
