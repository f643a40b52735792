"""Image pairs with their true geometry, which tells whether the matches of an engine are right."""

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
is below `RIGHT_PX`, which is chosen by hand. An answer (the matches of a pair) is right if at least
the fraction `MIN_CORRECT` of its matches is correct; with fewer, wrong ones are the majority."""

ROWS = np.array([[0, 0, 0], [0, 0, -1], [0, 1, 0.0]])
"""Fundamental matrix of a rectified pair, whose epipolar lines are the image rows."""

Images = tuple[np.ndarray, np.ndarray]
Answer = Literal["right", "wrong", "lost"]


@dataclass(frozen=True, eq=False)
class Truth:
    """The true geometry of a pair, by which an answer is judged.

    Attributes:
        homography: (3, 3) homography from the first image to the second, or None.
        plane: (H, W) bool, pixels of the first image where the homography holds; None: everywhere.
        fundamental: (3, 3) fundamental matrix that holds outside the plane. None: matches outside
            the plane are wrong.
        posed: the cameras. If they are known, an answer with the correct pose is right.
        by_pose: whether only the pose decides, because true epipolar lines may be off by pixels.
        right_px: error limit of a correct match, in pixels.
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
        cameras = self.posed.first.camera.matrix, self.posed.second.camera.matrix
        return float(pose_errors(estimate_pose(points0, points1, *cameras), self.posed)[ERROR])

    def judge(self, matches: Matches) -> Answer:
        """Return "lost" without matches, otherwise whether the answer is "right" or "wrong"."""
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
"""The truth of pairs whose images show nothing in common, or of which one image is blank. Every
answer with matches is wrong."""


@dataclass(frozen=True, eq=False)
class JudgedPair:
    """A pair of images and its truth. `kind` names its group; `make` reads or renders the images.

    `correspondences`, (K, 4), are hand-marked points x0, y0, x1, y1, by which the accuracy of the
    fundamental matrix is measured.
    """

    kind: str
    name: str
    make: Callable[[], Images]
    truth: Truth
    correspondences: np.ndarray | None = None
