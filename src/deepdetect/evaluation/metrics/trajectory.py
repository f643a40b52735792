"""Errors of a camera's path against the true one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..._shared.errors import OptionError
from ...geometry.relative_pose import rotation_angle


@dataclass(frozen=True, eq=False)
class TrajectoryErrors:
    """Errors of a path, all after the alignment that the function's docstring names.

    Attributes:
        scale: by which the estimated path was multiplied.
        end_percent: distance of the last positions, in per cent of the true path's length.
        mean_percent: mean distance of all positions, in per cent of the length.
        end_deg_per_m: angle between the last rotations, divided by the length.
        mean_deg_per_m: mean of that angle over all frames, divided by the length.
        length: of the true path.
        centres: (F, 3) the aligned positions.
    """

    scale: float
    end_percent: float
    mean_percent: float
    end_deg_per_m: float
    mean_deg_per_m: float
    length: float
    centres: np.ndarray


def trajectory_errors(
    rotations: np.ndarray, centres: np.ndarray, true_rotations: np.ndarray, true_centres: np.ndarray
) -> TrajectoryErrors:
    """Compare a path with the true one, after both begin in one pose and have one scale.

    The first camera of both is the origin, so that nothing but the scale, which a single camera
    cannot know, is taken from the truth. It is the one with the least squared distances of all
    positions.
    """
    turn = true_rotations[0] @ rotations[0].T
    moved = (centres - centres[0]) @ turn.T
    true = true_centres - true_centres[0]
    length = float(np.linalg.norm(np.diff(true, axis=0), axis=1).sum())
    scale = float((moved * true).sum() / (moved**2).sum())
    distances = np.linalg.norm(scale * moved - true, axis=1)
    angles = np.array(
        [rotation_angle(b.T @ turn @ a) for a, b in zip(rotations, true_rotations, strict=True)]
    )
    return TrajectoryErrors(
        scale,
        100 * float(distances[-1]) / length,
        100 * float(distances[1:].mean()) / length,
        float(angles[-1]) / length,
        float(angles[1:].mean()) / length,
        length,
        scale * moved + true_centres[0],
    )
