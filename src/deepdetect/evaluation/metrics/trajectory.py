"""Errors of a camera's path against the true one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..._shared.errors import OptionError
from ...geometry.relative_pose import rotation_angle

SEGMENTS_M = (10.0, 20.0, 30.0, 40.0, 50.0)
"""Lengths of the segments; KITTI's own, 100 to 800 m, are for paths of kilometres."""


@dataclass(frozen=True, eq=False)
class TrajectoryErrors:
    """Errors of a path, as `trajectory_errors` aligns it.

    Attributes:
        scale: by which the estimated path was multiplied, 0 for one that goes the wrong way.
        length: of the true path.
        end_percent: distance of the last positions, in per cent of this length.
        mean_percent: mean distance of all positions, in per cent of this length.
        end_deg_per_m: angle between the last rotations in degrees, divided by this length.
        segment_percent: mean error of the motion along all segments, in per cent of their length,
            as KITTI's benchmark measures it; NaN where the path is shorter than all of them.
        segment_deg_per_m: mean error of the rotation along them in degrees per metre.
        centres: (F, 3) the aligned positions.
    """

    scale: float
    length: float
    end_percent: float
    mean_percent: float
    end_deg_per_m: float
    segment_percent: float
    segment_deg_per_m: float
    centres: np.ndarray


def trajectory_errors(
    rotations: np.ndarray,
    centres: np.ndarray,
    true_rotations: np.ndarray,
    true_centres: np.ndarray,
    segments: Sequence[float] = SEGMENTS_M,
) -> TrajectoryErrors:
    """Compare a path with the true one, after both begin in one pose and have one scale.

    The first poses are made equal, and the scale, which a single camera cannot know, is the one
    with the least squared distances of all positions. Nothing else is taken from the truth.

    Args:
        rotations, true_rotations: (F, 3, 3), camera to world.
        centres, true_centres: (F, 3) positions.
        segments: lengths of the segments, in the unit of the true path.

    Raises:
        OptionError: the paths differ in length, have fewer than two poses, or do not move.

    Example:
        >>> turns, path = np.stack([np.eye(3)] * 3), np.array([[0.0, 0, 0], [0, 0, 5], [0, 0, 10]])
        >>> found = trajectory_errors(turns, path / 7, turns, path + [0, 2, 0])
        >>> round(found.scale, 3), round(found.end_percent, 3)
        (7.0, 0.0)
    """
    if len(centres) != len(true_centres) or len(centres) < 2:
        raise OptionError(
            f"paths must have the same poses, two at least, not {len(centres)} and "
            f"{len(true_centres)}"
        )
    turn = true_rotations[0] @ rotations[0].T
    moved = (np.asarray(centres) - centres[0]) @ turn.T
    turned = turn @ rotations
    true = np.asarray(true_centres) - true_centres[0]
    steps = np.linalg.norm(np.diff(true, axis=0), axis=1)
    along = np.concatenate([[0.0], steps.cumsum()])
    squares = float((moved**2).sum())
    if squares == 0 or along[-1] == 0:
        raise OptionError("a path that does not move has no scale: give one that does")
    # Below 0 it would turn a path that goes the wrong way into a right one.
    scale = max(0.0, float((moved * true).sum()) / squares)
    aligned = scale * moved
    distances = np.linalg.norm(aligned - true, axis=1)
    length = float(along[-1])
    segment_errors = _segment_errors(turned, aligned, true_rotations, true, along, segments)
    return TrajectoryErrors(
        scale,
        length,
        100 * float(distances[-1]) / length,
        100 * float(distances[1:].mean()) / length,
        rotation_angle(true_rotations[-1].T @ turned[-1]) / length,
        *segment_errors,
        aligned + true_centres[0],
    )


def _segment_errors(
    rotations: np.ndarray,
    centres: np.ndarray,
    true_rotations: np.ndarray,
    true_centres: np.ndarray,
    along: np.ndarray,
    segments: Sequence[float],
) -> tuple[float, float]:
    """Return the mean errors of the relative poses of all segments (Geiger et al., 2012)."""
    moves, turns = [], []
    for first in range(len(centres)):
        for length in segments:
            last = int(np.searchsorted(along, along[first] + length))
            if last == len(along):
                continue
            relative = rotations[first].T @ rotations[last]
            true_relative = true_rotations[first].T @ true_rotations[last]
            move = rotations[first].T @ (centres[last] - centres[first])
            true_move = true_rotations[first].T @ (true_centres[last] - true_centres[first])
            error = true_relative.T @ (move - true_move)
            moves.append(100 * float(np.linalg.norm(error)) / length)
            turns.append(rotation_angle(true_relative.T @ relative) / length)
    if not moves:
        return float("nan"), float("nan")
    return float(np.mean(moves)), float(np.mean(turns))
