"""Uniform frames of images."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import skimage.data

from deepdetect import DeepDetect, PointDetector
from deepdetect.geometry.frames import filled_smoothly, uniform_frame

COLOURS = [(0, 0, 0), (255, 255, 255), (30, 90, 160)]


def letter_box(size: tuple[int, int]) -> np.ndarray:
    inside = np.zeros(size[::-1], np.uint8)
    inside[40:-40] = 1
    return inside


def pillar_box(size: tuple[int, int]) -> np.ndarray:
    return np.ascontiguousarray(letter_box(size[::-1]).T)


def turned(size: tuple[int, int]) -> np.ndarray:
    move = cv2.getRotationMatrix2D((size[0] / 2, size[1] / 2), 8, 1)
    return cv2.warpAffine(np.ones(size[::-1], np.uint8), move, size, flags=cv2.INTER_NEAREST)


def round_rim(size: tuple[int, int]) -> np.ndarray:
    inside = np.zeros(size[::-1], np.uint8)
    return cv2.circle(inside, (size[0] // 2, size[1] // 2), size[1] // 2 - 4, 1, -1)


def undistorted(size: tuple[int, int]) -> np.ndarray:
    matrix = np.array([[size[0], 0, size[0] / 2], [0, size[0], size[1] / 2], [0, 0, 1.0]])
    distortion = np.array([-0.5, 0.1, 0, 0])
    new, _ = cv2.getOptimalNewCameraMatrix(matrix, distortion, size, 1)
    maps = cv2.initUndistortRectifyMap(matrix, distortion, None, new, size, cv2.CV_32FC1)
    return cv2.remap(np.ones(size[::-1], np.uint8), *maps, cv2.INTER_NEAREST)


@pytest.fixture(scope="module")
def scene() -> np.ndarray:
    return cv2.resize(skimage.data.astronaut(), (400, 300))


@pytest.mark.parametrize("colour", COLOURS)
@pytest.mark.parametrize("shape", [letter_box, pillar_box, turned, round_rim, undistorted])
def test_a_frame_of_any_colour_is_found_after_compression(shape, colour, scene) -> None:
    if shape is undistorted and colour == (255, 255, 255):
        pytest.skip("the wall in the scene is as bright")
    inside = shape((400, 300)) > 0
    framed = np.where(inside[..., None], scene, np.uint8(colour))
    framed = cv2.imdecode(cv2.imencode(".jpg", framed, [cv2.IMWRITE_JPEG_QUALITY, 85])[1], 1)
    require_frame(framed, inside, shape)


@pytest.mark.parametrize("shape", [letter_box, pillar_box, round_rim])
def test_a_noisy_frame_is_found(shape, scene) -> None:
    inside = shape((400, 300)) > 0
    framed = np.where(inside[..., None], scene, np.uint8((12, 20, 30)))
    noise = np.random.default_rng(0).integers(-3, 4, framed.shape)
    require_frame((framed + noise).clip(0, 255).astype(np.uint8), inside, shape)


def require_frame(framed: np.ndarray, inside: np.ndarray, shape) -> None:
    found = uniform_frame(framed)
    assert found[~inside].mean() > (0.75 if shape is undistorted else 0.98)
    deep = cv2.erode(np.uint8(inside), np.ones((41, 41)), borderValue=1) > 0
    assert found[deep].mean() < 0.1


def test_no_keypoint_lies_in_a_frame(scene) -> None:
    inside = round_rim((400, 300)) > 0
    framed = np.where(inside[..., None], scene, np.uint8(20))
    far_inside = cv2.erode(np.uint8(inside), np.ones((9, 9))) > 0
    for found in (
        PointDetector(2000).detect(framed),
        DeepDetect().detect(framed, density=0.1),
    ):
        column, row = np.rint(found.xy).astype(int).T
        assert len(found) > 300
        assert far_inside[row, column].all()


def test_what_is_no_frame_stays(scene) -> None:
    assert not uniform_frame(scene).any()
    sky = scene.copy()
    sky[:80] = 255
    for x in range(0, 400, 40):  # a skyline
        sky[40 + x % 60 : 80, x : x + 25] = scene[40 + x % 60 : 80, x : x + 25]
    assert not uniform_frame(sky).any()
    page = np.full((300, 400, 3), 255, np.uint8)
    for row in range(40, 280, 24):
        cv2.putText(page, "a page of text", (20, row), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 0))
    assert not uniform_frame(page).any()
    night = np.zeros((300, 400, 3), np.uint8)
    night[100:200, 60:130] = night[40:90, 250:300] = night[220:260, 300:390] = 200
    assert not uniform_frame(night).any()


def test_filling_is_smooth_and_keeps_the_rest(scene) -> None:
    gray = cv2.cvtColor(scene, cv2.COLOR_RGB2GRAY)
    mask = np.zeros(gray.shape, bool)
    mask[100:180, 120:260] = True
    filled = filled_smoothly(gray, mask)
    assert (filled[~mask] == gray[~mask]).all()
    assert np.abs(np.diff(filled[101:179, 121:259].astype(int))).max() < 30
    flat = np.full((64, 48), 77, np.uint8)
    assert (filled_smoothly(flat, mask[90:154, 110:158]) == 77).all()
