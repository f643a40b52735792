"""Every kind of hopeless input gets its own sentence, and good pairs get none."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from deepdetect import Matches, estimate_pose
from deepdetect._shared.errors import NoDepthError, ReconstructionError
from deepdetect._shared.progress import StageTimer
from deepdetect.geometry.camera import Calibration
from deepdetect.geometry.two_view import fit_model
from deepdetect.reconstruction.subpixel import refine_dense
from deepdetect.reconstruction.two_view import MAX_SCENE_DISTANCE_PX, NO_DEPTH, checked_pose

SIZE = (370, 250)


def scaled(calibration: Calibration, factor: float) -> Calibration:
    cameras = {
        name: replace(camera, focal_px=tuple(factor * focal for focal in camera.focal_px))
        for name, camera in (("camera0", calibration.camera0), ("camera1", calibration.camera1))
    }
    return replace(calibration, **cameras)


@pytest.fixture(scope="module")
def refined(turned: Any, turned_matches: Matches) -> tuple[np.ndarray, np.ndarray]:
    points0 = turned_matches.points0.astype(float)
    points1, converged = refine_dense(*turned.grays, points0, turned_matches.points1)
    return points0[converged][::3], points1[converged][::3]


@pytest.mark.parametrize("scene", ["rotation", "planar", "still", "none"])
def test_scenes_without_depth_are_refused_in_their_own_words(level: Any, scene: str) -> None:
    first, camera = level.left, level.calibration.camera0.matrix
    turn = camera @ cv2.Rodrigues(np.radians([3, -8, 4.0]))[0] @ np.linalg.inv(camera)
    tilt = np.array([[0.9, 0.12, 20.0], [-0.1, 0.95, 18.0], [4e-4, 1e-4, 1.0]])
    size, noise = first.shape[1::-1], np.random.default_rng(0).integers(0, 255, first.shape)
    others = {
        "rotation": cv2.warpPerspective(first, turn, size, flags=cv2.INTER_CUBIC),
        "planar": cv2.warpPerspective(first, tilt, size, flags=cv2.INTER_CUBIC),
        "still": first,
        "none": noise.astype(np.uint8),
    }
    with pytest.raises(NoDepthError) as error:
        estimate_pose(first, others[scene], calibration=level.calibration)
    assert str(error.value) == NO_DEPTH[scene]


def test_a_good_pair_passes_with_its_pose_and_focal_length(turned: Any, refined: Any) -> None:
    for factor in (0.9, 1, 1.1):
        check_all(refined, scaled(turned.calibration, factor))


def check_all(points: Any, calibration: Calibration) -> None:
    fundamental = fit_model(*points, "fundamental", SIZE, MAX_SCENE_DISTANCE_PX).matrix
    assert fundamental is not None
    checked_pose(*points, fundamental, calibration, 0, StageTimer())


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
