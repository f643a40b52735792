"""Every kind of hopeless input gets its own sentence, and good pairs get none."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from deepdetect import DeepDetect, Matches, PointDetector, match_features, match_images
from deepdetect._shared.errors import ReconstructionError
from deepdetect.geometry.camera import Calibration, Camera
from deepdetect.geometry.estimation import TwoViewModel
from deepdetect.geometry.relative_pose import estimate_relative_pose
from deepdetect.geometry.two_view import fit_model, has_foreground, is_planar
from deepdetect.io.image import load_image
from deepdetect.reconstruction.subpixel import refine_matches
from deepdetect.reconstruction.two_view import check_focal, check_matches, check_pose

from .conftest import halved

SIZE = (370, 250)


def sparse(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    detector = PointDetector(2000, descriptor="rootsift")
    found = match_features(*(detector.extract(image) for image in (first, second)))
    return found.points0, found.points1


def refusal(points: tuple[np.ndarray, ...], **known: Any) -> str:
    with pytest.raises(ReconstructionError) as error:
        check_matches(*points, SIZE, **known)
    return str(error.value)


def scaled(calibration: Calibration, factor: float) -> Calibration:
    cameras = {
        name: replace(camera, focal_px=tuple(factor * focal for focal in camera.focal_px))
        for name, camera in (("camera0", calibration.camera0), ("camera1", calibration.camera1))
    }
    return replace(calibration, **cameras)


@pytest.fixture(scope="module")
def refined(turned: Any, turned_matches: Matches) -> tuple[np.ndarray, np.ndarray]:
    points0 = turned_matches.points0.astype(float)
    points1, converged = refine_matches(*turned.grays, points0, turned_matches.points1)
    return points0[converged][::3], points1[converged][::3]


@pytest.mark.slow
@pytest.mark.parametrize("guide", ["auto", "fundamental"])
def test_a_camera_that_only_rotated(
    level: Any, only_turned: np.ndarray, guide: str, one_line
) -> None:
    found = match_images(level.left, only_turned, DeepDetect("dense"), model=guide)
    points = found.points0, found.points1
    camera = level.calibration.camera0
    assert "rotation" in refusal(points, calibration=Calibration(camera, camera))
    assert "plane" in refusal(points)


def test_a_plane(photo: np.ndarray) -> None:
    warp = np.array([[0.9, 0.12, 20.0], [-0.1, 0.95, 18.0], [4e-4, 1e-4, 1.0]])
    seen = cv2.warpPerspective(photo, warp, (256, 256), flags=cv2.INTER_CUBIC)
    calibration = Calibration(*[Camera((256, 256), 300)] * 2)
    assert "homography" in refusal(sparse(photo, seen), calibration=calibration)


@pytest.mark.parametrize("other", [2, 4])
@pytest.mark.parametrize(
    "name",
    [
        "bark",
        pytest.param("bikes", marks=pytest.mark.slow),
        pytest.param("leuven", marks=pytest.mark.slow),
        pytest.param("wall", marks=pytest.mark.slow),
    ],
)
def test_planar_photographs(shared: Path, name: str, other: int) -> None:
    images = [
        halved(load_image(shared / "data" / "oxford" / name / f"img{number}.png"))
        for number in (1, other)
    ]
    assert "homography" in refusal(sparse(*images))


def test_unrelated_photographs() -> None:
    data = pytest.importorskip("skimage.data")
    first, second = (
        np.ascontiguousarray(image[:250, :370]) for image in (data.astronaut(), data.coffee())
    )
    at_random = tuple(np.random.default_rng(0).uniform(0, SIZE, (2, 2000, 2)))
    for points in (sparse(first, second), at_random):
        assert "overlap" in refusal(points)


def test_no_overlap(level: Any) -> None:
    """Opposite quarters of one scene."""
    points = sparse(level.left[:125, :185], level.right[125:, 185:])
    assert "overlap" in refusal(points)
    refusal(tuple(np.empty((2, 0, 2))))


@pytest.mark.parametrize(
    "name",
    [
        "cones",
        "teddy",
        pytest.param("art", marks=pytest.mark.slow),
        pytest.param("dolls", marks=pytest.mark.slow),
        pytest.param("moebius", marks=pytest.mark.slow),
        pytest.param("rocks", marks=pytest.mark.slow),
        pytest.param("cloth", marks=pytest.mark.slow),
    ],
)
def test_scenes_with_depth_pass(shared: Path, name: str) -> None:
    folder = shared / "data" / "middlebury" / name
    points = sparse(*(load_image(folder / f"{side}.png") for side in ("left", "right")))
    _, epipolar = check_matches(*points, SIZE)
    assert epipolar.inliers.mean() > 0.8
    assert epipolar.log10_nfa < -50


def test_a_good_pair_passes_with_its_pose_and_focal_length(turned: Any, refined: Any) -> None:
    for factor in (0.9, 1, 1.1):
        check_all(refined, scaled(turned.calibration, factor))


def check_all(points: Any, calibration: Calibration) -> None:
    cells, epipolar = check_matches(*points, SIZE, calibration)
    pose = check_pose(estimate_relative_pose(*points, calibration), cells, epipolar, calibration)
    used = cells[epipolar.inliers]
    check_focal(points[0][used], points[1][used], pose.errors[used], calibration)


@pytest.mark.parametrize("factor", [0.2, 0.3, 0.5])
def test_a_wrong_focal_length(turned: Any, refined: Any, factor: float) -> None:
    calibration = scaled(turned.calibration, factor)
    with pytest.raises(ReconstructionError) as error:
        check_all(refined, calibration)
    message = str(error.value)
    assert f"{calibration.camera0.focal_px[0]:.0f} px" in message
    if factor == 0.5:  # the right one is named
        assert re.search(r" (4[5-9]\d|5[0-4]\d) px", message)


@pytest.mark.parametrize("factor", [0.4, 1.0, 2.0, 3.0])
def test_too_long_a_focal_length_is_seen_where_the_camera_turned_more(
    far_turned: Any, factor: float
) -> None:
    pixels = np.indices(SIZE).reshape(2, -1).T[::5].astype(np.float64)
    there = far_turned.match(pixels)
    there += np.random.default_rng(0).normal(0, 0.15, there.shape)
    known = np.isfinite(there).all(1)
    points, calibration = (pixels[known], there[known]), scaled(far_turned.calibration, factor)
    if factor == 1:
        check_all(points, calibration)
        return
    with pytest.raises(ReconstructionError):
        check_all(points, calibration)


def test_what_stands_in_front_of_a_plane() -> None:
    """100 matches on the plane, 10 off it, some explained by the fundamental matrix."""
    off_plane = np.append(np.ones(100), np.full(10, 20.0))
    for explained, expected in ((10, True), (8, True), (7, False), (0, False)):
        by_fundamental = np.ones(110, bool)
        by_fundamental[100 + explained :] = False
        assert has_foreground(off_plane, by_fundamental) == expected
    assert not has_foreground(off_plane[:104], np.ones(104, bool))  # under 5 %


@pytest.mark.parametrize("wrong", [0, 300])
def test_a_plane_is_one_also_among_wrong_matches_and_depth_is_none(wrong: int) -> None:
    """Up to 100 of 300 matches on a plane move further along their rows."""
    generator = np.random.default_rng(0)
    points0 = generator.uniform(0, 500, (300 + wrong, 2))
    noise = generator.normal(0, 0.3, points0.shape)
    for nearer, expected in ((0, True), (15, True), (70, False), (100, False)):
        points1 = points0 + 5 + noise
        points1[:nearer, 0] += np.linspace(8, 40, nearer)
        points1[300:] = np.random.default_rng(1).uniform(0, 500, (wrong, 2))
        plane, epipolar = (
            fit_model(points0, points1, model, (500, 500), threshold)
            for model, threshold in (("homography", 2), ("fundamental", 1.5))
        )
        planar = is_planar(points0, points1, plane, epipolar)
        assert planar is expected
    nothing = TwoViewModel("none", None, np.zeros(len(points0), bool), np.inf)
    assert not is_planar(points0, points1, nothing, epipolar)
