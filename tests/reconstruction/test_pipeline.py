"""Both pipelines from two photographs to points, compared with the truth."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import deepdetect
from deepdetect import (
    DeepDetect,
    OptionError,
    PointDetector,
    ReconstructionError,
    SelectionOptions,
)
from deepdetect._shared import machine
from deepdetect._shared.errors import ImageError
from deepdetect.geometry.camera import Calibration, Camera
from deepdetect.geometry.point_cloud import PointCloud
from deepdetect.matching.stereo import disparity_map
from deepdetect.reconstruction import estimate_pose
from deepdetect.reconstruction.outliers import PointFilterOptions
from deepdetect.reconstruction.result import Reconstruction
from deepdetect_lab.datasets.middlebury import load_middlebury
from deepdetect_lab.evaluation.baselines.random import AllPixels

CONES_POINTS = 49_979
"""The paper's count."""


def reconstruct(left: Any, right: Any, detector: Any = None, **settings: Any) -> Any:
    """Call the function with the settings of a selection among the others."""
    names = {field.name for field in dataclasses.fields(SelectionOptions)} & settings.keys()
    chosen = {name: settings.pop(name) for name in names}
    selection = SelectionOptions(**chosen) if chosen else None
    return deepdetect.reconstruct(left, right, detector, selection=selection, **settings)


@pytest.fixture(scope="module")
def detector() -> DeepDetect:
    return DeepDetect("dense")


@pytest.fixture(scope="module")
def cones(shared: Path) -> Any:
    return load_middlebury(shared / "data" / "middlebury" / "cones")


@pytest.fixture(scope="module")
def found(cones: Any, detector: DeepDetect) -> Reconstruction:
    return reconstruct(cones.left, cones.right, detector, focal_px=500)


@pytest.fixture(scope="module")
def posed(turned: Any, detector: DeepDetect) -> Reconstruction:
    return reconstruct(turned.left, turned.right, detector, calibration=turned.calibration)


def shares(found: Reconstruction, pair: Any, *limits: float) -> list[float]:
    """Return the shares of the points whose true disparity is known that are within limits."""
    column, row = found.pixels.astype(int).T
    error = np.abs(found.disparity - pair.disparity[row, column])
    return [float((error[np.isfinite(error)] <= limit).mean()) for limit in limits]


def test_cones_have_more_points_than_the_papers_and_they_are_true(found: Any, cones: Any) -> None:
    assert found.rectified
    assert found.rectification.rectified
    assert len(found) >= CONES_POINTS
    within1, within2 = shares(found, cones, 1, 2)
    assert within1 >= 0.95
    assert within2 >= 0.985
    assert found.matched.all()


def test_every_pixel_is_as_complete_and_true_as_opencv(cones: Any, detector: DeepDetect) -> None:
    """The figures are those of OpenCV's semi-global matching on this scene."""
    complete = reconstruct(cones.left, cones.right, detector, focal_px=500, density=1)
    error = np.abs(complete.disparity_map() - cones.disparity)
    true = np.isfinite(cones.disparity)
    assert np.count_nonzero(error[true] <= 1) / np.count_nonzero(true) >= 0.862
    assert shares(complete, cones, 1)[0] >= 0.921
    assert not complete.matched.all()
    assert np.count_nonzero(complete.matched_map()) == np.count_nonzero(complete.matched)
    assert complete.keypoints == cones.left.shape[0] * cones.left.shape[1]


@pytest.mark.parametrize("offset", [-40, 60])
def test_with_an_offset_no_depth_is_invented(offset: int, cones: Any) -> None:
    """The views are cropped on opposite sides; the depths stay those of the whole pair."""
    kept = cones.left.shape[1] - abs(offset)
    starts = max(-offset, 0), max(offset, 0)
    left, right = (
        view[:, start : start + kept]
        for view, start in zip((cones.left, cones.right), starts, strict=True)
    )
    cameras = [Camera((kept, 375), 500, (224.5 - start, 187)) for start in starts]
    found = reconstruct(
        left, right, AllPixels(), calibration=Calibration(*cameras), rectified=True, density=1
    )
    truth = cones.disparity[:, starts[0] : starts[0] + kept]
    column, row = found.pixels.astype(int).T
    true = truth[row, column]
    known = np.isfinite(true)
    right_one = np.abs(500 / found.points[:, 2] - true) <= 1
    assert right_one[known].mean() > 0.93
    assert right_one[known & found.matched].mean() > 0.96
    place = column - true - offset
    outside = known & ((place < -0.5) | (place > kept - 0.5))
    assert outside.sum() > 1_000
    assert right_one[outside].mean() > 0.8
    assert found.matched[outside].mean() < 0.1


def test_points_are_the_disparities_by_the_calibration(found: Any) -> None:
    """z = f b / d, and x and y where the pixel looks: x right, y down, z forward."""
    expected = 500 / found.disparity
    np.testing.assert_allclose(found.points[:, 2], expected, rtol=1e-5)
    seen = found.calibration.camera0.project(found.points)
    np.testing.assert_allclose(seen, found.pixels, atol=1e-3)
    there = found.calibration.camera1.project(found.points - found.baseline_vector)
    np.testing.assert_allclose(there[:, 0], found.pixels[:, 0] - found.disparity, atol=1e-3)
    np.testing.assert_allclose(there[:, 1], found.pixels[:, 1], atol=1e-3)
    top = found.points[found.pixels[:, 1] < 100]
    assert (top[:, 1] < 0).all()


@pytest.mark.parametrize("pipeline", ["found", "posed"])
def test_arrays_belong_together(
    pipeline: str, request: pytest.FixtureRequest, cones: Any, turned: Any
) -> None:
    made: Reconstruction = request.getfixturevalue(pipeline)
    image = cones.left if pipeline == "found" else turned.left
    count = len(made)
    assert made.points.shape == (count, 3)
    assert made.points.dtype == np.float32
    assert made.colors.dtype == np.uint8
    assert made.pixels.shape == (count, 2)
    assert (made.disparity is None) == (pipeline == "posed")
    assert np.isfinite(made.points).all()
    assert (made.points[:, 2] > 0).all()
    column, row = made.pixels.astype(int).T
    np.testing.assert_array_equal(image[row, column], made.colors)
    assert len(np.unique(made.pixels, axis=0)) == count
    assert count + sum(made.dropped.values()) == made.matches <= made.keypoints
    depth = made.depth_map()
    assert depth.shape == image.shape[:2]
    np.testing.assert_array_equal(depth[row, column], made.points[:, 2])
    assert np.isfinite(depth).sum() == count
    assert isinstance(made.cloud, PointCloud)
    assert len(made.cloud) == count
    assert all(value >= 0 for value in made.seconds.values())


def test_a_pair_that_is_not_rectified_has_true_depths(posed: Any, turned: Any) -> None:
    assert not posed.rectified
    assert not posed.rectification.rectified
    assert posed.unit == "baseline"
    assert len(posed) > 25_000
    true = turned.points(posed.pixels)
    known = np.isfinite(true[:, 2])
    off = np.abs(posed.points[known, 2] / true[known, 2] - 1)
    assert np.median(off) < 0.015
    assert (off < 0.05).mean() > 0.9
    assert turned.rotation_error(posed.pose.rotation) < 0.1
    np.testing.assert_allclose(np.linalg.norm(posed.baseline_vector), 1)
    assert len(posed.reprojection_errors) == len(posed)
    with pytest.raises(ReconstructionError, match="depth_map"):
        posed.disparity_map()


@pytest.mark.slow
def test_a_post_before_a_wall_has_points_of_both_depths(facade: Any, detector: DeepDetect) -> None:
    pair = facade(0.07)
    camera = Camera((400, 300), 400.0)
    made = reconstruct(pair.left, pair.right, detector, calibration=Calibration(camera, camera))
    assert not made.rectified
    column, row = made.pixels.astype(int).T
    near = pair.near[row, column]
    baseline = np.linalg.norm([1.0, 0.06, 0.1])
    for part, depth, fewest in ((near, 5, 1000), (~near, 10, 20_000)):
        assert np.count_nonzero(part) > fewest
        off = np.abs(made.points[part, 2] * baseline / depth - 1)
        assert np.median(off) < 0.02
        assert (off < 0.1).mean() > 0.9


def test_the_right_camera_is_where_it_is_seen_from(posed: Any, turned: Any) -> None:
    """Points seen from there lie on their true matches, and the parallax is the rays' angle."""
    there = (posed.points - posed.baseline_vector) @ posed.pose.rotation.T
    seen = turned.calibration.camera1.project(there)
    gap = np.linalg.norm(seen - turned.match(posed.pixels), axis=1)
    assert np.nanmedian(gap) < 0.5
    rays = posed.points / np.linalg.norm(posed.points, axis=1, keepdims=True)
    others = posed.points - posed.baseline_vector
    others /= np.linalg.norm(others, axis=1, keepdims=True)
    angle = np.degrees(2 * np.arcsin(np.linalg.norm(rays - others, axis=1) / 2))
    np.testing.assert_allclose(posed.triangulation_angles(), angle, rtol=1e-3)


@pytest.mark.slow
def test_the_pose_alone_is_true(turned: Any) -> None:
    pose = estimate_pose(turned.left, turned.right, calibration=turned.calibration)
    assert turned.rotation_error(pose.rotation) < 0.3
    assert turned.direction_error(pose.translation) < 2


def test_both_pipelines_agree_on_a_rectified_pair(level: Any, detector: DeepDetect) -> None:
    """Forced each way the depths are the same; found out it is the rectified one."""
    ways = [
        reconstruct(level.left, level.right, detector, calibration=level.calibration, rectified=way)
        for way in (True, False, None)
    ]
    assert [way.rectified for way in ways] == [True, False, True]
    assert [way.rectification is None for way in ways] == [True, True, False]
    np.testing.assert_array_equal(ways[0].points, ways[2].points)
    ratio = ways[0].depth_map() / ways[1].depth_map()
    ratio = ratio[np.isfinite(ratio)]
    assert len(ratio) > 20_000
    assert abs(np.median(ratio) - 1) < 0.02


@pytest.mark.slow
def test_is_the_same_for_any_number_of_threads(
    turned: Any, level: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = []
    before = cv2.getNumThreads()
    try:
        for count in (1, 3):
            monkeypatch.setattr(machine, "processor_count", lambda count=count: count)
            cv2.setNumThreads(count)
            results.append(
                [
                    reconstruct(
                        *(pair.left, pair.right, AllPixels()),
                        calibration=pair.calibration,
                        max_keypoints=15_000,
                    ).points
                    for pair in (level, turned)
                ]
            )
    finally:
        cv2.setNumThreads(before)
    for one, three in zip(*results, strict=True):
        np.testing.assert_array_equal(one, three)


@pytest.mark.slow
def test_options_reach_their_stages(level: Any, detector: DeepDetect) -> None:
    pair = level.left, level.right, detector
    known = {"calibration": level.calibration}
    plain = reconstruct(*pair, **known)
    assert reconstruct(*pair, **known, max_keypoints=3000).keypoints == 3000
    keep = PointFilterOptions(sor_neighbors=0)
    all_kept = reconstruct(*pair, **known, point_filter=keep)
    outliers = "statistical outlier"
    assert outliers not in all_kept.dropped
    assert len(all_kept) == len(plain) + plain.dropped[outliers]
    stricter = reconstruct(*pair, **known, point_filter=PointFilterOptions(sor_std_ratio=0.5))
    assert stricter.dropped[outliers] > plain.dropped[outliers]
    near = reconstruct(*pair, **known, point_filter=replace(keep, min_parallax_px=20))
    offset = near.calibration.disparity_offset_px
    assert near.disparity.min() + offset == pytest.approx(20, abs=0.5)
    assert len(near) == np.count_nonzero(all_kept.disparity + offset >= 20) < len(all_kept)
    asked = reconstruct(*pair, **known, rectified=True)
    assert asked.rectification is None
    np.testing.assert_array_equal(asked.points, plain.points)


def test_keypoints_of_a_rectified_pair_only_choose_pixels_of_the_disparity_map(
    level: Any, detector: DeepDetect
) -> None:
    made = reconstruct(
        level.left, level.right, detector, calibration=level.calibration, rectified=True
    )
    expected = disparity_map(level.left, level.right).disparity
    column, row = made.pixels.astype(int).T
    np.testing.assert_array_equal(made.disparity, expected[row, column])


def refusal(*pair: Any, **options: Any) -> str:
    with pytest.raises(ReconstructionError) as error:
        reconstruct(*pair, AllPixels(), **{"focal_px": 497.5, **options})
    return str(error.value)


def middle(*images: np.ndarray) -> list[np.ndarray]:
    """Return some of their rows, as what is wrong is seen in these too."""
    return [image[60:200] for image in images]


@pytest.mark.parametrize("density", [None, 1])
def test_pairs_only_said_to_be_rectified_give_no_cloud(
    density: int | None, level: Any, turned: Any, only_turned: Any, photo: Any
) -> None:
    options = {"rectified": True, "density": density}
    other = cv2.resize(photo, (370, 250))
    for pair in ((turned.left, turned.right), (level.left, only_turned), (level.left, other)):
        assert "row" in refusal(*middle(*pair), **options)
    left, right = middle(level.left, level.right)
    noise = np.random.default_rng(0).normal(0, 6, left.shape)
    noisy = np.clip(left + noise, 0, 255).astype(np.uint8)
    assert "two different places" in refusal(left, noisy, **options)
    assert "exchanged" in refusal(right, left, **options)
    shifted = np.ascontiguousarray(left[:, 9:]), np.ascontiguousarray(left[:, :-9])
    assert "-9 px" in refusal(*shifted, **options)


def test_a_pair_taken_in_the_dark_has_depth(level: Any) -> None:
    """The images have a mean of 6 grey levels."""
    factor = 6 / level.left.mean()
    dark = [np.rint(view * factor).astype(np.uint8) for view in (level.left, level.right)]
    found = reconstruct(*dark, AllPixels(), calibration=level.calibration, rectified=True)
    column, row = found.pixels.astype(int).T
    off = np.abs(found.disparity - level.disparity[row, column])
    assert len(found) > 10_000
    assert np.nanmedian(off) < 0.5


@pytest.mark.parametrize("density", [None, 1])
def test_a_small_rotation_said_to_be_rectified_gives_no_cloud(
    density: int | None, level: Any
) -> None:
    camera = level.calibration.camera0
    known = {"focal_px": None, "calibration": Calibration(camera, camera), "rectified": True}
    for degrees in (-0.5, 1.0, 4.0):
        rotation = cv2.Rodrigues(np.radians([0, degrees, 0]))[0]
        warp = camera.matrix @ rotation @ np.linalg.inv(camera.matrix)
        other = cv2.warpPerspective(level.left, warp, camera.size, flags=cv2.INTER_CUBIC)
        assert "rotation" in refusal(level.left, other, density=density, **known)


def test_what_is_wrong_is_said(level: Any) -> None:
    pair = left, right = middle(level.left, level.right)
    again = cv2.imdecode(cv2.imencode(".jpg", left)[1], cv2.IMREAD_COLOR)
    refusal(left, again)
    assert "two different places" in refusal(left, again, rectified=True)
    assert "exchanged" in refusal(right, left)
    assert "EXIF" in refusal(*pair, focal_px=None)
    with pytest.raises(OptionError):
        reconstruct(*pair, AllPixels(), focal_px=500, calibration=level.calibration)
    with pytest.raises(OptionError):
        reconstruct(*pair, AllPixels(), focal_px=500, seed=-1)
    refusal(*pair, point_filter=PointFilterOptions(min_parallax_px=1e4))
    narrow = np.ascontiguousarray(level.right[:, :-4])
    known = {"focal_px": None, "calibration": level.calibration}
    assert "370x250" in refusal(level.left, narrow, **known)
    with pytest.raises(ImageError):
        reconstruct(level.left, narrow, AllPixels(), focal_px=500, rectified=True)


def test_points_of_all_scales_are_reconstructed(cones: Any, turned: Any) -> None:
    points = PointDetector(1500, spread="grid")
    made = reconstruct(cones.left, cones.right, points, focal_px=500, rectified=True)
    assert 400 < len(made) <= 1500  # margins of depth edges and lonely points are left out
    np.testing.assert_array_equal(made.pixels, np.rint(made.pixels))
    assert shares(made, cones, 2)[0] > 0.95
    pair = turned.left, turned.right, points
    made = reconstruct(*pair, calibration=turned.calibration, rectified=False)
    assert not made.rectified
    assert 500 < len(made) <= 1500
    assert np.median(made.reprojection_errors) < 1
