"""The path of a camera, and its file in KITTI's format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .._shared.atomic import atomic_path
from .._shared.errors import InvalidFileError, MissingFileError, OptionError
from .._shared.options import suggest_keywords
from .tracks import read_table


@suggest_keywords
@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of a camera.

    A point X of the camera's frame (x right, y down, z forward) is rotation @ X + centre in the
    world's.

    Attributes:
        frames: (F,) int64 numbers of the frames that have a pose, rising.
        rotations: (F, 3, 3) float64, camera to world.
        centres: (F, 3) float64 positions of the camera.

    Raises:
        OptionError: the shapes do not fit together.
    """

    frames: np.ndarray
    rotations: np.ndarray
    centres: np.ndarray

    def __post_init__(self) -> None:
        count = len(self.frames)
        if np.shape(self.rotations) != (count, 3, 3) or np.shape(self.centres) != (count, 3):
            raise OptionError(
                f"{count} frames need rotations ({count}, 3, 3) and centres ({count}, 3), not "
                f"{np.shape(self.rotations)} and {np.shape(self.centres)}"
            )

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def length(self) -> float:
        """Length of the path."""
        return float(np.linalg.norm(np.diff(self.centres, axis=0), axis=1).sum())

    def at(self, frames: np.ndarray) -> Trajectory:
        """Return the poses of some frames.

        Raises:
            OptionError: one of them has no pose.
        """
        rows = np.searchsorted(self.frames, frames).clip(0, max(0, len(self) - 1))
        missing = np.asarray(frames)[self.frames[rows] != frames] if len(self) else frames
        if len(missing):
            raise OptionError(f"frame {missing[0]} has no pose: choose others")
        return Trajectory(self.frames[rows], self.rotations[rows], self.centres[rows])


@suggest_keywords
def save_poses(trajectory: Trajectory, path: str | Path) -> None:
    """Write poses as KITTI and evo do: on each line the 3x4 matrix from camera to world, by rows.

    The numbers of the frames are not written: the file is for a trajectory without gaps.

    Raises:
        DeepDetectError: the file cannot be written.
    """
    matrices = np.concatenate([trajectory.rotations, trajectory.centres[..., None]], axis=2)
    with atomic_path(path) as temporary, temporary.open("w", encoding="ascii") as file:
        np.savetxt(file, matrices.reshape(-1, 12), fmt="%.9e")


@suggest_keywords
def load_poses(path: str | Path) -> Trajectory:
    """Read poses in KITTI's format; frames are numbered from 0 on.

    Raises:
        DeepDetectError: the file is missing or is no such file.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "poses.txt"
        >>> save_poses(Trajectory(np.arange(2), np.stack([np.eye(3)] * 2), np.eye(3)[:2]), path)
        >>> load_poses(path).centres.tolist()
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    """
    try:
        with Path(path).open(encoding="utf-8") as file:
            matrices = read_table(file, 12).reshape(-1, 3, 4)
        if not np.isfinite(matrices).all():
            raise ValueError("a number is not finite")
    except FileNotFoundError:
        raise MissingFileError(f"there is no file {path}: check the path") from None
    except (OSError, ValueError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InvalidFileError(
            f"{path} holds no poses ({reason}): give 12 numbers on each line"
        ) from None
    return Trajectory(np.arange(len(matrices)), matrices[:, :, :3], matrices[:, :, 3])
