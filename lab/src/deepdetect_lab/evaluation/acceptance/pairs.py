"""A pair of images with its true geometry, and whether an answer to it is right."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from deepdetect import Matches
from deepdetect.geometry.transforms import epipolar_errors, transfer_errors

from ...datasets.posed_images import PosedPair
from ..protocols.pose import ERROR, GOOD_DEG, estimate_pose, pose_errors

RIGHT_PX, MIN_CORRECT = 3.0, 0.5
"""A match is correct if its transfer error on a plane, or else its distance from its epipolar line,
is below the first value. An answer is right if at least the second fraction of its matches is
correct, because more wrong ones would outvote them."""

ROWS = np.array([[0, 0, 0], [0, 0, -1], [0, 1, 0.0]])
"""Fundamental matrix of a rectified pair."""

Images = tuple[np.ndarray, np.ndarray]
Answer = Literal["right", "wrong", "lost"]


@dataclass(frozen=True, eq=False)
class Truth:
    """The true geometry of a pair, from which an answer is judged.

    Attributes:
        homography: (3, 3) homography from the first image to the second, or None.
        plane: (H, W) bool, where the homography holds; None: everywhere.
        fundamental: (3, 3) fundamental matrix that holds elsewhere; without it, matches elsewhere
            are wrong.
        posed: the cameras. If they are known, an answer with the correct pose is right.
        by_pose: only the pose decides. The epipolar lines of the truth may be off by pixels.
        right_px: error limit of a correct match.
        depth: whether the answer must say that the scene has depth.
    """

    homography: np.ndarray | None = None
    plane: np.ndarray | None = None
    fundamental: np.ndarray | None = None
    posed: PosedPair | None = None
    by_pose: bool = False
    right_px: float = RIGHT_PX
    depth: bool = False

    def correct(self, points0: np.ndarray, points1: np.ndarray) -> np.ndarray:
        """Return which of (M, 2) matches are correct, (M,) bool."""
        near = np.zeros(len(points0), bool)
        if self.fundamental is not None:
            near = epipolar_errors(points0, points1, self.fundamental) < self.right_px
        if self.homography is None:
            return near
        right = transfer_errors(points0, points1, self.homography) < self.right_px
        if self.plane is None:
            return np.asarray(right)
        x, y = np.rint(points0).astype(np.int64).T
        return np.where(self.plane[y, x], right, near)

    def pose_error(self, points0: np.ndarray, points1: np.ndarray) -> float | None:
        """Return the error in degrees of the pose that the matches give; None without cameras."""
        if self.posed is None:
            return None
        cameras = self.posed.first.intrinsics, self.posed.second.intrinsics
        return float(pose_errors(estimate_pose(points0, points1, *cameras), self.posed)[ERROR])

    def judge(self, matches: Matches) -> Answer:
        """Return whether an answer is right; without matches it is "lost"."""
        if not len(matches):
            return "lost"
        assert matches.geometry is not None
        ends = matches.points0, matches.points1
        if self.depth and not matches.geometry.scene.startswith("depth"):
            return "wrong"
        if not self.by_pose and self.correct(*ends).mean() >= MIN_CORRECT:
            return "right"
        error = self.pose_error(*ends)
        return "right" if error is not None and error < GOOD_DEG else "wrong"


UNRELATED = Truth()
"""The truth of images that show nothing in common, and of those that do not tell what they show:
every answer is wrong."""


@dataclass(frozen=True, eq=False)
class JudgedPair:
    """Two images of one kind and their truth. `make` reads or renders the images.

    `correspondences`, (K, 4), are x0, y0, x1, y1 of places marked by hand, from which the accuracy
    of the fundamental matrix is measured.
    """

    kind: str
    name: str
    make: Callable[[], Images]
    truth: Truth
    correspondences: np.ndarray | None = None
