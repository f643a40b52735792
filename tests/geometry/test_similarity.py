"""Similarities of made points: with noise, wrong targets, and on a line."""

from __future__ import annotations

import numpy as np
import pytest

from deepdetect import ReconstructionError
from deepdetect.geometry.similarity import Similarity, fit_similarity

TURN = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
TRUE = Similarity(7.5, TURN * np.linalg.det(TURN), np.array([120.0, -40.0, 8.0]))
UP = TRUE.rotation.T @ [0, 0, 1.0]


def angle_deg(first: np.ndarray, second: np.ndarray) -> float:
    cosine = (np.trace(first @ second.T) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def test_exact_points_give_the_similarity_itself() -> None:
    points = np.random.default_rng(0).normal(size=(10, 3))
    fit = fit_similarity(points, TRUE.apply(points), 0.1)
    assert fit.similarity.scale == pytest.approx(TRUE.scale, rel=1e-6)
    np.testing.assert_allclose(fit.similarity.rotation, TRUE.rotation, atol=1e-6)
    np.testing.assert_allclose(fit.similarity.translation, TRUE.translation, atol=1e-5)
    np.testing.assert_allclose(fit.residuals, 0, atol=1e-5)
    assert not fit.wrong.any()


@pytest.mark.parametrize("seed", range(5))
def test_wrong_targets_are_named_and_change_nothing(seed: int) -> None:
    """Noise of 3 m, two of 200 m, on a path of some 300 m."""
    random = np.random.default_rng(seed)
    at = np.linspace(0, 5, 30)
    points = np.column_stack([3 * at, 4 * np.sin(at), 0.2 * np.cos(3 * at)])
    targets = TRUE.apply(points) + random.normal(0, 3, (30, 3))
    targets[[4, 21]] += [[200.0, 0, 0], [-120, 160, 0]]
    fit = fit_similarity(points, targets, 3.0)
    assert np.flatnonzero(fit.wrong).tolist() == [4, 21]
    # What it says of its own errors holds: all are within three standard deviations.
    assert abs(fit.similarity.scale / TRUE.scale - 1) < 3 * fit.scale_std < 0.06
    assert (
        angle_deg(fit.similarity.rotation, TRUE.rotation) < 3 * np.hypot(*fit.axes_std_deg[:2]) + 2
    )
    assert np.median(np.abs(fit.residuals)) == pytest.approx(2, rel=0.3)


def test_on_a_line_what_is_level_decides() -> None:
    random = np.random.default_rng(0)
    points = np.outer(np.arange(12), [1.0, 0.2, 0])
    targets = TRUE.apply(points) + random.normal(0, 0.3, (12, 3))
    level = np.cross(UP, random.normal(size=(20, 3)))
    level /= np.linalg.norm(level, axis=1)[:, None]
    known = {"up": UP, "level": level, "level_stds": np.full(20, 0.05)}
    fit = fit_similarity(points, targets, 0.3, **known)
    assert fit.axis_std_deg_of_targets > 90  # these leave it open
    assert fit.axes_std_deg.max() < 3
    assert angle_deg(fit.similarity.rotation, TRUE.rotation) < 2
    # A known scale stays.
    fixed = fit_similarity(points, targets, 0.3, scale=7.0, **known)
    assert (fixed.similarity.scale, fixed.scale_std) == (7.0, 0)


def test_heights_may_be_unknown() -> None:
    points = np.random.default_rng(0).normal(size=(20, 3))
    targets = TRUE.apply(points)
    targets[::2, 2] = np.nan
    fit = fit_similarity(points, targets, 0.1)
    assert angle_deg(fit.similarity.rotation, TRUE.rotation) < 1e-3
    np.testing.assert_array_equal(np.isnan(fit.residuals), np.isnan(targets))


def test_points_in_one_place_have_no_similarity() -> None:
    with pytest.raises(ReconstructionError):
        fit_similarity(np.ones((5, 3)), np.random.default_rng(0).normal(size=(5, 3)), 1.0)
