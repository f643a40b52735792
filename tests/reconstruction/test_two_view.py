from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from deepdetect import Matches
from deepdetect._shared.errors import ReconstructionError
from deepdetect._shared.progress import StageTimer
from deepdetect.reconstruction.outliers import PointFilterOptions
from deepdetect.reconstruction.two_view import reconstruct_two_view, refined_corners


def reconstruct(
    turned: Any, matches: Matches, calibration: Any = None, keep: Any = PointFilterOptions()
) -> dict[str, Any]:
    calibration = calibration or turned.calibration
    return reconstruct_two_view(matches, turned.grays, calibration, keep, 0, StageTimer())


@pytest.fixture(scope="module")
def few(turned_matches: Matches) -> Matches:
    return turned_matches[::4]


@pytest.fixture(scope="module")
def found(turned: Any, turned_matches: Matches) -> dict[str, Any]:
    return reconstruct(turned, turned_matches)


def depth_errors(turned: Any, found: dict[str, Any]) -> np.ndarray:
    """Return the shares by which depths are off, where the truth is known."""
    true = turned.points(found["pixels"])[:, 2]
    return np.abs(found["points"][:, 2] / true - 1)[np.isfinite(true)]


def test_the_pose_is_that_of_refined_corners(turned: Any, found: Any) -> None:
    depth = depth_errors(turned, found)
    assert (depth < 0.02).mean() > 0.9
    assert turned.rotation_error(found["pose"].rotation) < 0.05
    assert turned.direction_error(found["pose"].translation) < 0.5
    assert 1000 < len(found["pose"].errors) < 10_000 < len(found["points"])


def test_a_pose_does_not_depend_on_how_starts_are_rounded(turned: Any, few: Matches) -> None:
    """Matches may start between pixels; what is aligned is the patch of the nearest one."""
    shift = np.random.default_rng(0).uniform(-0.45, 0.45, few.points0.shape).astype(np.float32)
    points = few.points0 + shift, few.points1 + shift
    pixels, refined = refined_corners(turned.grays, *points)
    expected = refined_corners(turned.grays, few.points0, few.points1)
    np.testing.assert_array_equal(pixels, np.rint(pixels))
    either = {(x, y): end for (x, y), end in zip(map(tuple, expected[0]), expected[1], strict=True)}
    gaps = [
        np.abs(either[tuple(at)] - end).max()
        for at, end in zip(pixels, refined, strict=True)
        if tuple(at) in either
    ]
    assert len(gaps) > 0.9 * len(pixels)
    assert np.median(gaps) < 0.005


def test_points_lie_where_their_pixels_look(
    turned: Any, turned_matches: Matches, found: Any
) -> None:
    """x right, y down, z forward, and each point on the ray of its own match."""
    seen = turned.calibration.camera0.project(found["points"])
    assert np.abs(seen - found["pixels"]).max() < 1.5
    assert found["reprojection_errors"].max() < 1
    assert (found["points"][:, 2] > 0).all()
    assert len(found["points"]) + sum(found["dropped"].values()) == len(turned_matches)
    assert len(found["points"]) == len(found["pixels"]) == len(found["reprojection_errors"])


def test_a_known_baseline_gives_millimetres(turned: Any, few: Matches) -> None:
    found = reconstruct(turned, few)
    calibration = replace(turned.calibration, baseline_mm=193.001)
    metric = reconstruct(turned, few, calibration)
    np.testing.assert_array_equal(metric["pixels"], found["pixels"])
    np.testing.assert_allclose(metric["points"], found["points"] * 193.001, rtol=1e-5)


def test_wrong_matches_are_taken_out(turned: Any, few: Matches) -> None:
    found = reconstruct(turned, few)
    generator = np.random.default_rng(0)
    wrong = generator.random(len(few)) < 0.3
    points1 = few.points1.copy()
    points1[wrong] = generator.integers((0, 0), (370, 250), (wrong.sum(), 2))
    other = reconstruct(turned, replace(few, points1=points1))
    assert turned.rotation_error(other["pose"].rotation) < 0.1
    bad = {tuple(pixel) for pixel in few.points0[wrong].tolist()}
    assert np.mean([tuple(pixel) in bad for pixel in other["pixels"].tolist()]) < 0.02
    assert len(other["points"]) > 0.5 * len(found["points"])


def test_the_point_filter_reaches_its_stages(turned: Any, few: Matches) -> None:
    keep = PointFilterOptions(sor_neighbors=0, min_parallax_px=0)
    made = reconstruct(turned, few, keep=keep)
    assert "statistical outlier" not in made["dropped"]
    assert made["dropped"]["parallax"] == 0
    far = reconstruct(turned, few, keep=replace(keep, min_parallax_px=40))
    assert len(far["points"]) < len(made["points"])
    assert far["dropped"]["parallax"] > 0
    with pytest.raises(ReconstructionError):
        reconstruct(turned, few, keep=replace(keep, min_parallax_px=1e4))
