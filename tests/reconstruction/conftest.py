"""A real pair with known geometry: Motorcycle at half size, its views turned by known rotations."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from deepdetect import DeepDetect, Matches, match_images
from deepdetect.geometry.camera import Calibration, Camera
from deepdetect.io.image import luma
from deepdetect_lab.datasets import load_motorcycle

FOCAL, OFFSET, BASELINE = 994.978 / 2, 31.086 / 2, 193.001
"""In pixels and mm, of the page of skimage.data.stereo_motorcycle, at half size."""


@dataclass(frozen=True, eq=False)
class Turned:
    """Both views, the second camera's pose, and what is true.

    `points` and `match` take (N, 2) whole pixels of the left view to (N, 3) places in its frame in
    baselines, and to (N, 2) places in the right one; NaN where it is unknown.
    """

    left: np.ndarray
    right: np.ndarray
    calibration: Calibration
    rotation: np.ndarray
    translation: np.ndarray
    disparity: np.ndarray
    homographies: tuple[np.ndarray, np.ndarray]
    turns: tuple[np.ndarray, np.ndarray]

    @property
    def grays(self) -> tuple[np.ndarray, np.ndarray]:
        return luma(self.left), luma(self.right)

    def rotation_error(self, rotation: np.ndarray) -> float:
        """Degrees between a rotation and the true one."""
        return float(np.degrees(np.linalg.norm(cv2.Rodrigues(rotation @ self.rotation.T)[0])))

    def direction_error(self, translation: np.ndarray) -> float:
        """Degrees between a translation and the true one."""
        across = np.linalg.norm(np.cross(translation, self.translation))
        return float(np.degrees(np.arctan2(across, translation @ self.translation)))

    def points(self, pixels: np.ndarray) -> np.ndarray:
        places, disparity = self._rectified(pixels)
        rays = self.calibration.camera0.rays(places)
        return (rays * (FOCAL / (disparity + OFFSET))[:, None]) @ self.turns[0].T

    def match(self, pixels: np.ndarray) -> np.ndarray:
        places, disparity = self._rectified(pixels)
        places[:, 0] -= disparity
        there = cv2.perspectiveTransform(places[None], self.homographies[1])[0]
        return np.where(np.isfinite(places), there, np.nan)  # OpenCV makes 0 of NaN

    def _rectified(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        back = np.linalg.inv(self.homographies[0])
        places = cv2.perspectiveTransform(np.asarray(pixels, np.float64)[None], back)[0]
        column, row = np.rint(places).astype(int).T
        height, width = self.disparity.shape
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        found = self.disparity[np.where(inside, row, 0), np.where(inside, column, 0)]
        return places, np.where(inside, found, np.nan)


def rotation(*degrees: float) -> np.ndarray:
    return cv2.Rodrigues(np.radians(np.array(degrees, np.float64)))[0]


def turn(image: np.ndarray, camera: Camera, turned: np.ndarray) -> np.ndarray:
    """Show an image as the camera sees it after a turn."""
    homography = camera.matrix @ turned @ np.linalg.inv(camera.matrix)
    return cv2.warpPerspective(image, homography, camera.size, flags=cv2.INTER_CUBIC)


def halved(image: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    return cv2.resize(image, (width // 2, height // 2), interpolation=cv2.INTER_AREA)


def make(turn0: np.ndarray, turn1: np.ndarray) -> Turned:
    pytest.importorskip("skimage.data", reason="needs scikit-image for the Motorcycle pair")
    pair = load_motorcycle()
    left, right = halved(pair.left[:, :740]), halved(pair.right[:, :740])
    size = (370, 250)
    # Half size: the centre of the first pixel moves by a quarter of a new one.
    cx, cy = 311.193 / 2 - 0.25, 254.877 / 2 - 0.25
    cameras = (Camera(size, FOCAL, (cx, cy)), Camera(size, FOCAL, (cx + OFFSET, cy)))
    homographies = tuple(
        camera.matrix @ turned @ np.linalg.inv(camera.matrix)
        for camera, turned in zip(cameras, (turn0, turn1), strict=True)
    )
    return Turned(
        turn(left, cameras[0], turn0),
        turn(right, cameras[1], turn1),
        Calibration(*cameras, source="calib.json"),
        turn1 @ turn0.T,
        -turn1[:, 0],
        pair.disparity[:500:2, :740:2] / 2,
        homographies,
        (turn0, turn1),
    )


@pytest.fixture(scope="session")
def turned() -> Turned:
    return make(rotation(1, 0, -1), rotation(2, -3, 4))


@pytest.fixture(scope="session")
def far_turned() -> Turned:
    return make(rotation(1, 2, -3), rotation(4, -6, 8))


@pytest.fixture(scope="session")
def level() -> Turned:
    return make(np.eye(3), np.eye(3))


@pytest.fixture(scope="session")
def only_turned(level: Turned) -> np.ndarray:
    """The left view of the level pair after a turn of its camera."""
    return turn(level.left, level.calibration.camera0, rotation(2, -5, 3))


@pytest.fixture(scope="session")
def turned_matches(turned: Turned) -> Matches:
    """Matches of every pixel of the heat map, sub-pixel by rectification."""
    found = match_images(turned.left, turned.right, DeepDetect("dense"))
    assert found.subpixel
    return found
