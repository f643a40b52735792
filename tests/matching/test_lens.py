"""A camera turns in a random sphere: a fisheye is refused, and a pinhole is matched."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
import pytest

from deepdetect import ImageError, PointDetector, estimate_pose, match_images, stitch

HEIGHT = 1024
SIZE, FOCAL = (640, 480), 320.0
DETECTOR = PointDetector(2000)


@pytest.fixture(scope="module")
def sphere() -> np.ndarray:
    noise = np.random.default_rng(0).uniform(0, 255, (HEIGHT, 2 * HEIGHT)).astype(np.float32)
    layers = [cv2.GaussianBlur(noise, (0, 0), sigma) * sigma for sigma in (2, 4, 8)]
    return cv2.normalize(np.sum(layers, axis=0), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def view(sphere: np.ndarray, turn: float, fisheye: bool) -> np.ndarray:
    """The sphere in a camera turned by an angle in radians about the vertical axis."""
    y, x = np.indices(SIZE[::-1]) - (np.array(SIZE[::-1])[:, None, None] - 1) / 2
    radius = np.hypot(x, y)
    angle = radius / FOCAL if fisheye else np.arctan(radius / FOCAL)
    side = np.sin(angle) / radius
    ray = np.stack([side * x, side * y, np.cos(angle)], axis=-1)
    longitude = np.arctan2(ray[..., 0], ray[..., 2]) + turn + np.pi
    latitude = np.arcsin(ray[..., 1]) + np.pi / 2
    places = [(each * HEIGHT / np.pi).astype(np.float32) for each in (longitude, latitude)]
    return cv2.remap(sphere, *places, cv2.INTER_LINEAR)


@pytest.mark.parametrize(
    "work",
    [
        partial(match_images, detector=DETECTOR),
        partial(estimate_pose, detector=DETECTOR, focal_px=FOCAL),
        lambda one, other: stitch([one, other], DETECTOR),
    ],
)
def test_a_fisheye_that_fills_the_frame_is_refused(sphere: np.ndarray, work: Callable) -> None:
    with pytest.raises(ImageError, match="undistort"):
        work(view(sphere, -0.15, True), view(sphere, 0.15, True))


@pytest.mark.parametrize("model", ["auto", "fundamental"])
def test_a_wide_pinhole_is_matched(sphere: np.ndarray, model: str) -> None:
    found = match_images(
        view(sphere, -0.15, False), view(sphere, 0.15, False), DETECTOR, model=model
    )
    assert found.success


def test_a_homography_may_be_asked_for(sphere: np.ndarray) -> None:
    pair = view(sphere, -0.15, True), view(sphere, 0.15, True)
    match_images(*pair, DETECTOR, model="homography")
