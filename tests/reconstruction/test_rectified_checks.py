from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from deepdetect._shared.errors import ReconstructionError
from deepdetect.datasets.middlebury import load_middlebury
from deepdetect.geometry.camera import Calibration, Camera
from deepdetect.io.image import luma
from deepdetect.matching.stereo import DENSE, DisparityOptions, disparity_map
from deepdetect.reconstruction.rectification import (
    check_cameras,
    check_depths,
    check_disparities,
    check_pure_rotation,
)


def test_disparities_that_do_not_differ(shared: Path, one_line) -> None:
    noise = np.random.default_rng(0).normal(0, 0.1, 1000)
    for disparity, message in (
        (noise, "without a baseline"),
        (5 * noise, "without a baseline"),
        (np.zeros(10), "without a baseline"),
        (noise + 40, "all disparities are 40"),
        (noise - 7, "all disparities are -7"),
        (np.full(5, np.nan), "no disparity was found"),
        (np.empty(0), "no disparity was found"),
    ):
        with pytest.raises(ReconstructionError, match=message) as error:
            check_disparities(disparity)
        one_line(error.value)
    for name in ("art", "cones", "dolls"):
        check_disparities(load_middlebury(shared / "data" / "middlebury" / name).disparity)
    check_disparities(np.append(np.full(90, 7.0), np.full(10, 9.0)))
    check_disparities(np.append(np.full(85, 0.1), np.full(15, 9.0)))


def test_points_behind_the_cameras(one_line) -> None:
    camera = Camera((400, 300), 500.0)
    calibration = Calibration(camera, replace(camera, centre=(229.5, 149.5)), source="c.json")
    disparity = np.linspace(-20, 60, 1000)
    check_depths(disparity, calibration)  # the offset is 30
    with pytest.raises(ReconstructionError, match="100% of the points would lie behind") as error:
        check_depths(-50 - disparity[300:], calibration)
    assert "the disparity offset of 30 px (c.json) is wrong" in one_line(error.value)
    plain = Calibration(camera, camera)
    check_depths(disparity[200:], plain)
    with pytest.raises(ReconstructionError, match="left and right are exchanged"):
        check_depths(-disparity[250:], plain)


def test_cameras_that_no_rectified_pair_has(one_line) -> None:
    left = Camera((640, 480), 500.0, (320.0, 240.0))

    def refusal(**changes: Any) -> str:
        with pytest.raises(ReconstructionError) as error:
            check_cameras(Calibration(left, replace(left, **changes), source="c.json"))
        message = one_line(error.value)
        assert "fix the calibration (c.json), or pass `rectified=False`" in message
        return message

    assert "are 500 and 510 px" in refusal(focal_px=(510.0, 500.0))
    assert "are 500 and 490 px" in refusal(focal_px=(500.0, 490.0))
    assert "cy of the left and the right view are 240 and 243 px" in refusal(centre=(320.0, 243.0))
    for changes in ({"focal_px": 504.0}, {"centre": (390.0, 240.0)}, {"centre": (320.0, 238.5)}):
        check_cameras(Calibration(left, replace(left, **changes)))


PIXELS = np.stack(np.meshgrid(np.arange(0, 640, 8.0), np.arange(0, 480, 8.0)), -1).reshape(-1, 2)


def turned_disparity(calibration: Calibration, degrees: tuple[float, ...]) -> np.ndarray:
    rotation = cv2.Rodrigues(np.radians(np.array(degrees)))[0]
    rays = calibration.camera0.rays(PIXELS)
    seen = calibration.camera1.project(rays @ rotation.T)
    return PIXELS[:, 0] - seen[:, 0] + np.random.default_rng(0).normal(0, 0.1, len(PIXELS))


@pytest.mark.parametrize("degrees", [(0, -1, 0), (0, 2, 0), (0, -0.5, 0), (0.05, -1, 0.2)])
def test_a_rotation_is_recognised_by_its_bend(degrees: tuple[float, ...], one_line) -> None:
    camera = Camera((640, 480), 600.0)
    right = replace(camera, focal_px=602.0, centre=(350.0, 239.5))
    for calibration in (Calibration(camera, camera), Calibration(camera, right)):
        disparity = turned_disparity(calibration, degrees)
        wrong = np.random.default_rng(1).random(len(PIXELS)) < 0.3
        disparity[wrong] += 9
        with pytest.raises(ReconstructionError, match="a rotation of the camera explains") as error:
            check_pure_rotation(PIXELS, disparity, calibration)
        one_line(error.value)


@pytest.mark.parametrize("focal", [300.0, 600.0, 3000.0])
@pytest.mark.parametrize("slant", [(0, 0), (2e-3, 0), (0, 3e-3), (0.01, -0.01), (0.1, 0)])
def test_a_wall_before_two_cameras_is_no_rotation(slant: tuple[float, float], focal: float) -> None:
    camera = Camera((640, 480), focal)
    noise = np.random.default_rng(0).normal(0, 0.1, len(PIXELS))
    for shift in (0, 5, 40):
        check_pure_rotation(PIXELS, shift + PIXELS @ slant + noise, Calibration(camera, camera))


@pytest.mark.parametrize("name", ["art", "cones", "dolls", "moebius", "teddy"])
def test_scenes_with_depth_are_no_rotation(shared: Path, name: str) -> None:
    true = load_middlebury(shared / "data" / "middlebury" / name).disparity
    row, column = np.nonzero(np.isfinite(true))
    pixels = np.stack([column, row], 1).astype(np.float64)
    for focal in (0.5, 1, 3):
        camera = Camera(true.shape[::-1], focal * true.shape[1])
        check_pure_rotation(pixels, true[row, column], Calibration(camera, camera))


@pytest.mark.parametrize("options", [DisparityOptions(), DENSE], ids=["strict", "complete"])
@pytest.mark.parametrize("degrees", [0.5, 1, 2, 4])
def test_a_photograph_of_a_rotated_camera(
    level: Any, options: DisparityOptions, degrees: float
) -> None:
    camera = level.calibration.camera0
    rotation = cv2.Rodrigues(np.radians([0, -degrees, 0]))[0]
    warp = camera.matrix @ rotation @ np.linalg.inv(camera.matrix)
    other = cv2.warpPerspective(level.left, warp, camera.size, flags=cv2.INTER_CUBIC)
    pixels = np.indices(camera.size).reshape(2, -1).T[::3].astype(np.float32)
    for right, calibration in (
        (other, Calibration(camera, camera)),
        (level.right, level.calibration),
    ):
        found = disparity_map(luma(level.left), luma(right), options).at(pixels)
        matches = pixels[found.indices][found.matched], found.disparity[found.matched]
        check_disparities(matches[1])
        if right is level.right:
            check_pure_rotation(*matches, calibration)
            continue
        with pytest.raises(ReconstructionError, match="a rotation of the camera explains"):
            check_pure_rotation(*matches, calibration)
