from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from deepdetect import PointDetector, match_features
from deepdetect._shared.errors import NoDepthError, ReconstructionError
from deepdetect.geometry.camera import Calibration, Camera
from deepdetect.io.image import load_image, luma
from deepdetect.matching.guided import ImagePair, Sources
from deepdetect.reconstruction.rectification import (
    check_cameras,
    check_depths,
    check_disparities,
    check_pure_rotation,
    detect_rectification,
    find_rectification,
)
from deepdetect_lab.datasets import load_motorcycle
from deepdetect_lab.datasets.middlebury import load_middlebury

from .conftest import halved

SCENES = [
    *("art", "cones", "teddy"),
    *(
        pytest.param(name, marks=pytest.mark.slow)
        for name in ("cloth", "dolls", "moebius", "rocks")
    ),
]
OXFORD = ("bark", "bikes", "boat", "graf", "leuven", "trees", "ubc", "wall")
QUICK = (("boat", 6), ("graf", 6), ("ubc", 6))


@cache
def sparse_matches(first: Path, second: Path) -> tuple[np.ndarray, ...]:
    """Match keypoints without any geometry; positions and (width, height) of the images."""
    images = [load_image(path) for path in (first, second)]
    images = images if "middlebury" in str(first) else map(halved, images)
    detector = PointDetector(2000, descriptor="rootsift")
    features = [detector.extract(image) for image in images]
    found = match_features(*features)
    return found.points0, found.points1, features[0].image_size


def scene(shared: Path, name: str) -> tuple[np.ndarray, ...]:
    folder = shared / "data" / "middlebury" / name
    return sparse_matches(folder / "left.png", folder / "right.png")


def with_wrong(points: tuple[np.ndarray, ...], size: Any, share: float) -> list[np.ndarray]:
    """Add random matches until they are a share of all."""
    generator = np.random.default_rng(0)
    count = round(len(points[0]) * share / (1 - share))
    return [np.concatenate([part, generator.uniform((0, 0), size, (count, 2))]) for part in points]


@pytest.mark.parametrize("name", SCENES)
def test_rectified_scenes_are_recognised_exchanged_and_among_wrong_matches(
    shared: Path, name: str
) -> None:
    points0, points1, size = scene(shared, name)
    found = detect_rectification(points0, points1, size)
    assert found.rectified, found
    assert found.reason == ""
    assert not found.swapped
    assert found.disparities[0] > 0
    many = detect_rectification(*with_wrong((points0, points1), size, 0.8), size)
    assert many.rectified, many
    exchanged = detect_rectification(points1, points0, size)
    assert exchanged.rectified
    assert exchanged.swapped
    # An offset that is larger than all disparities: negative ones are in order.
    assert not detect_rectification(points1, points0, size, offset_px=500).swapped


@pytest.mark.parametrize("wrong", [0.0, 0.8])
@pytest.mark.parametrize("name", SCENES)
def test_moved_and_turned_views_are_not_rectified(shared: Path, name: str, wrong: float) -> None:
    points0, points1, size = scene(shared, name)
    turn = cv2.getRotationMatrix2D((size[0] / 2, size[1] / 2), 1, 1)
    for other in (points1 + [0, 3], points1 - [0, 3], points1 @ turn[:, :2].T + turn[:, 2]):
        points = with_wrong((points0, other), size, wrong)
        found = detect_rectification(*points, size)
        assert not found.rectified, found
        assert "same row" in found.reason


@pytest.mark.parametrize(
    ("name", "other"),
    [
        pytest.param(name, other, marks=[] if (name, other) in QUICK else pytest.mark.slow)
        for name in OXFORD
        for other in (6, 2)
    ],
)
def test_planar_scenes_are_not_rectified(shared: Path, name: str, other: int) -> None:
    folder = shared / "data" / "oxford" / name
    found = detect_rectification(*sparse_matches(folder / "img1.png", folder / f"img{other}.png"))
    assert not found.rectified, found
    assert found.reason


def test_one_disparity_and_unequal_sizes_are_not_rectified() -> None:
    points = np.random.default_rng(0).uniform(0, 400, (800, 2))
    found = detect_rectification(points, points - [7, 0], (400, 400))
    assert not found.rectified
    assert "same disparity (7 px)" in found.reason
    for other in ((400, 390), (390, 400)):
        found = find_rectification(np.zeros((400, 400), np.uint8), np.zeros(other, np.uint8))
        assert not found.rectified
        assert "differ in size" in found.reason
    same = detect_rectification(points, points, (400, 400))
    assert not same.rectified


def test_a_slanted_plane_is_rectified_and_a_small_turn_is_not() -> None:
    points = np.random.default_rng(0).uniform((0, 0), (640, 480), (2000, 2))
    plane = points - np.column_stack([5 + points[:, 1] / 20, np.zeros(2000)])
    assert detect_rectification(points, plane, (640, 480)).rectified
    squeezed = points - np.column_stack([5 + points[:, 0] / 150, points[:, 1] / 500])
    found = detect_rectification(points, squeezed, (640, 480))
    assert "one homography explains" in found.reason


def test_the_figures_are_those_of_the_pair() -> None:
    generator = np.random.default_rng(0)
    points = generator.uniform((0, 0), (640, 480), (3000, 2))
    disparity = generator.uniform(10, 50, 3000)
    found = detect_rectification(
        points, points - np.column_stack([disparity, np.zeros(3000)]), (640, 480)
    )
    assert found.on_rows == found.matches
    assert found.disparities == pytest.approx((12, 30, 48), abs=0.7)


@pytest.fixture(scope="module")
def motorcycle() -> tuple[np.ndarray, np.ndarray]:
    pytest.importorskip("skimage.data", reason="needs scikit-image for the Motorcycle pair")
    pair = load_motorcycle()
    return luma(pair.left)[60:460, 150:650], luma(pair.right)[60:460, 150:650]


def enlarged(pair: tuple[np.ndarray, np.ndarray], factor: float) -> list[np.ndarray]:
    zoom = {"fx": factor, "fy": factor, "interpolation": cv2.INTER_CUBIC}
    return [cv2.resize(view, None, **zoom) for view in pair]


def moved(image: np.ndarray, matrix: Any) -> np.ndarray:
    size = image.shape[::-1]
    options = {"flags": cv2.INTER_CUBIC, "borderMode": cv2.BORDER_REFLECT}
    return cv2.warpAffine(image, np.array(matrix, np.float64), size, **options)


def test_small_copies_of_large_images_decide_alone(motorcycle: Any) -> None:
    left, right = enlarged(motorcycle, 1.5)
    found = find_rectification(left, right)
    assert found.rectified
    assert not found.swapped
    size = left.shape[::-1]
    fine = Sources(ImagePair((left, right))).dense
    expected = detect_rectification(fine.points0, fine.points1, size)
    for own, other in zip(found.disparities[::2], expected.disparities[::2], strict=True):
        assert own == pytest.approx(other, rel=0.1)
    exchanged = find_rectification(right, left)
    assert exchanged.rectified
    assert exchanged.swapped
    with_offset = find_rectification(right, left, offset_px=500)
    assert with_offset.rectified
    assert not with_offset.swapped


def test_rows_off_by_less_than_small_copies_show_are_seen_on_larger_ones(motorcycle: Any) -> None:
    """By one pixel, which is half of one of the copies."""
    left, right = enlarged(motorcycle, 2)
    found = find_rectification(left, moved(right, [[1, 0, 0], [0, 1, 1]]))
    assert not found.rectified


def test_rows_bent_by_a_lens_are_not_taken_for_level(motorcycle: Any) -> None:
    """By some pixels at the border; a plane through the shifts is level."""
    left, right = enlarged(motorcycle, 2)
    height, width = left.shape
    y, x = np.mgrid[:height, :width].astype(np.float32)
    bent = cv2.remap(right, x, y + 6 * (2 * x / width - 1) ** 2 - 2, cv2.INTER_CUBIC)
    found = find_rectification(left, bent)
    assert not found.rectified


def test_disparities_that_do_not_differ(shared: Path) -> None:
    noise = np.random.default_rng(0).normal(0, 0.1, 1000)
    for disparity in (noise, 5 * noise, np.zeros(10), noise + 40, noise - 7):
        with pytest.raises(NoDepthError):
            check_disparities(disparity)
    for name in ("art", "cones", "dolls"):
        disparity = load_middlebury(shared / "data" / "middlebury" / name).disparity
        check_disparities(disparity[np.isfinite(disparity)])
    check_disparities(np.append(np.full(90, 7.0), np.full(10, 9.0)))
    check_disparities(np.append(np.full(85, 0.1), np.full(15, 9.0)))


def test_points_behind_the_cameras() -> None:
    camera = Camera((400, 300), 500.0)
    calibration = Calibration(camera, replace(camera, centre=(229.5, 149.5)), source="c.json")
    disparity = np.linspace(-20, 60, 1000)
    check_depths(disparity, calibration)  # the offset is 30
    with pytest.raises(ReconstructionError, match=r"30 px \(c\.json\)"):
        check_depths(-50 - disparity[300:], calibration)
    plain = Calibration(camera, camera)
    check_depths(disparity[200:], plain)
    with pytest.raises(ReconstructionError):
        check_depths(-disparity[250:], plain)


def test_cameras_that_no_rectified_pair_has() -> None:
    left = Camera((640, 480), 500.0, (320.0, 240.0))
    for changes in ({"focal_px": (510.0, 500.0)}, {"centre": (320.0, 243.0)}):
        with pytest.raises(ReconstructionError, match=r"c\.json.*`rectified=False`"):
            check_cameras(Calibration(left, replace(left, **changes), source="c.json"))
    for changes in ({"focal_px": 504.0}, {"centre": (390.0, 240.0)}, {"centre": (320.0, 238.5)}):
        check_cameras(Calibration(left, replace(left, **changes)))


PIXELS = np.stack(np.meshgrid(np.arange(0, 640, 8.0), np.arange(0, 480, 8.0)), -1).reshape(-1, 2)


def turned_disparity(calibration: Calibration, degrees: tuple[float, ...]) -> np.ndarray:
    rotation = cv2.Rodrigues(np.radians(np.array(degrees)))[0]
    rays = calibration.camera0.rays(PIXELS)
    seen = calibration.camera1.project(rays @ rotation.T)
    return PIXELS[:, 0] - seen[:, 0] + np.random.default_rng(0).normal(0, 0.1, len(PIXELS))


@pytest.mark.parametrize("degrees", [(0, -1, 0), (0, 2, 0), (0, -0.5, 0), (0.05, -1, 0.2)])
def test_a_rotation_is_recognised_by_its_bend(degrees: tuple[float, ...]) -> None:
    camera = Camera((640, 480), 600.0)
    right = replace(camera, focal_px=602.0, centre=(350.0, 239.5))
    for calibration in (Calibration(camera, camera), Calibration(camera, right)):
        disparity = turned_disparity(calibration, degrees)
        wrong = np.random.default_rng(1).random(len(PIXELS)) < 0.3
        disparity[wrong] += 9
        with pytest.raises(ReconstructionError):
            check_pure_rotation(PIXELS, disparity, calibration)


@pytest.mark.parametrize("focal", [300.0, 600.0, 3000.0])
@pytest.mark.parametrize("slant", [(0, 0), (2e-3, 0), (0, 3e-3), (0.01, -0.01), (0.1, 0)])
def test_a_wall_before_two_cameras_is_no_rotation(slant: tuple[float, float], focal: float) -> None:
    camera = Camera((640, 480), focal)
    noise = np.random.default_rng(0).normal(0, 0.1, len(PIXELS))
    for shift in (0, 5, 40):
        check_pure_rotation(PIXELS, shift + PIXELS @ slant + noise, Calibration(camera, camera))


@pytest.mark.parametrize("name", ["art", "cones", "teddy"])
def test_scenes_with_depth_are_no_rotation(shared: Path, name: str) -> None:
    true = load_middlebury(shared / "data" / "middlebury" / name).disparity
    row, column = np.nonzero(np.isfinite(true))
    pixels = np.stack([column, row], 1).astype(np.float64)
    for focal in (0.5, 1, 3):
        camera = Camera(true.shape[::-1], focal * true.shape[1])
        check_pure_rotation(pixels, true[row, column], Calibration(camera, camera))
