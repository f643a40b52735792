from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from deepdetect._shared.errors import ReconstructionError
from deepdetect.reconstruction.outliers import PointFilterOptions
from deepdetect.reconstruction.two_view import (
    TwoViewReconstruction,
    reconstruct_two_view,
)


@pytest.fixture(scope="module")
def found(turned: Any, turned_matches: Any) -> TwoViewReconstruction:
    return reconstruct_two_view(*turned_matches, turned.calibration, turned.grays)


def depth_errors(turned: Any, found: TwoViewReconstruction, points0: np.ndarray) -> np.ndarray:
    """Return the shares by which depths are off, where the truth is known."""
    true = turned.points(points0[found.indices])[:, 2]
    return np.abs(found.points[:, 2] / true - 1)[np.isfinite(true)]


def test_pose_and_depth_are_true(turned: Any, turned_matches: Any, found: Any) -> None:
    assert len(found.points) > 0.6 * len(turned_matches[0])
    assert turned.rotation_error(found.pose.rotation) < 0.1
    assert turned.direction_error(found.pose.translation) < 1
    errors = depth_errors(turned, found, turned_matches[0])
    assert np.median(errors) < 0.015
    assert (errors < 0.05).mean() > 0.9
    assert found.pose.cheirality_ratio > 0.99


@pytest.fixture(scope="module")
def as_they_are(turned: Any, turned_matches: Any) -> TwoViewReconstruction:
    return reconstruct_two_view(*turned_matches, turned.calibration, turned.grays, refined=True)


def test_matches_of_rectified_rows_are_taken_as_they_are(
    turned: Any, turned_matches: Any, found: Any, as_they_are: Any
) -> None:
    points0, points1 = turned_matches
    np.testing.assert_array_equal(as_they_are.points1, points1[as_they_are.indices])
    assert "not refined" not in as_they_are.dropped
    assert len(as_they_are.points) + sum(as_they_are.dropped.values()) == len(points0)
    assert len(as_they_are.points) > 1.1 * len(found.points)
    shares = []
    for made in (found, as_they_are):
        off = np.linalg.norm(made.points1 - turned.match(points0[made.indices]), axis=1)
        shares.append((off[np.isfinite(off)] < 0.25).mean())
    assert shares[1] > shares[0] + 0.05
    depth = [depth_errors(turned, made, points0) for made in (found, as_they_are)]
    assert np.count_nonzero(depth[1] < 0.02) > 1.1 * np.count_nonzero(depth[0] < 0.02)
    assert (depth[1] < 0.02).mean() > (depth[0] < 0.02).mean() - 0.01


def test_their_pose_is_that_of_corners_refined_alone(
    turned: Any, turned_matches: Any, as_they_are: Any
) -> None:
    """Across their epipolar lines they say what rectified the pair, and are exact about it."""
    assert turned.rotation_error(as_they_are.pose.rotation) < 0.05
    assert turned.direction_error(as_they_are.pose.translation) < 0.5
    assert 1000 < len(as_they_are.pose_indices) < 10_000 < len(as_they_are.points)
    assert len(as_they_are.pose.errors) == len(as_they_are.pose_indices)
    unrefined = reconstruct_two_view(*turned_matches, turned.calibration)
    errors = [turned.rotation_error(made.pose.rotation) for made in (as_they_are, unrefined)]
    assert errors[0] < 0.5 * errors[1]


def test_points_lie_where_their_pixels_look(turned: Any, turned_matches: Any, found: Any) -> None:
    """x right, y down, z forward, and each point on the ray of its own match."""
    points0, _ = turned_matches
    calibration, pose = turned.calibration, found.pose
    seen = calibration.camera0.project(found.points)
    assert np.abs(seen - points0[found.indices]).max() < 1.5
    there = calibration.camera1.project(found.points @ pose.rotation.T + pose.translation)
    gaps = np.stack([seen - points0[found.indices], there - found.points1])
    error = np.sqrt((gaps**2).sum((0, 2)) / 2)
    np.testing.assert_allclose(error, found.reprojection_errors, atol=2e-3)
    assert found.reprojection_errors.max() < 1
    assert (found.points[:, 2] > 0).all()


def test_all_matches_are_accounted_for(turned_matches: Any, found: Any) -> None:
    assert len(found.points) + sum(found.dropped.values()) == len(turned_matches[0])
    assert (np.diff(found.indices) > 0).all()
    assert len(found.points) == len(found.points1) == len(found.reprojection_errors)
    assert found.dropped["not refined"] == len(turned_matches[0]) - len(found.pose_indices)


def test_a_known_baseline_gives_millimetres(turned: Any, turned_matches: Any, found: Any) -> None:
    calibration = replace(turned.calibration, baseline_mm=193.001)
    metric = reconstruct_two_view(*turned_matches, calibration, turned.grays)
    np.testing.assert_array_equal(metric.indices, found.indices)
    np.testing.assert_allclose(metric.points, found.points * 193.001, rtol=1e-5)


def test_wrong_matches_are_taken_out(turned: Any, turned_matches: Any, found: Any) -> None:
    points0, points1 = (part.copy() for part in turned_matches)
    generator = np.random.default_rng(0)
    wrong = generator.random(len(points1)) < 0.3
    points1[wrong] = generator.integers((0, 0), (370, 250), (wrong.sum(), 2))
    other = reconstruct_two_view(points0, points1, turned.calibration, turned.grays)
    assert turned.rotation_error(other.pose.rotation) < 0.1
    assert wrong[other.indices].mean() < 0.02
    assert len(other.points) > 0.5 * len(found.points)


def test_options_switch_stages_off(turned: Any, turned_matches: Any) -> None:
    keep = PointFilterOptions(sor_neighbors=0, min_parallax_px=0)
    found = reconstruct_two_view(*turned_matches, turned.calibration, turned.grays, keep)
    assert "statistical outlier" not in found.dropped
    assert found.dropped["parallax"] == 0
    far = reconstruct_two_view(
        *turned_matches,
        turned.calibration,
        None,
        replace(keep, min_parallax_px=40),
    )
    assert len(far.points) < len(found.points)
    assert far.dropped["parallax"] > 0


def test_what_gives_no_point_is_said(turned: Any, turned_matches: Any) -> None:
    with pytest.raises(ReconstructionError, match="parallax: "):
        reconstruct_two_view(
            *turned_matches,
            turned.calibration,
            None,
            point_filter=PointFilterOptions(min_parallax_px=1e4),
        )
