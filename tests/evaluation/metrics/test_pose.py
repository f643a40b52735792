from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect.evaluation.metrics.homography import area_under_curve
from deepdetect.evaluation.metrics.pose import (
    epipolar_inlier_ratio,
    pose_auc,
    rotation_error,
    translation_error,
)

INF = float("inf")


@pytest.mark.parametrize("degrees", [0, 1e-4, 0.5, 30, 90, 179, 180])
def test_rotations_differ_by_the_angle_that_was_turned(degrees: float) -> None:
    rng = np.random.default_rng(0)
    true = cv2.Rodrigues(rng.normal(size=3))[0]
    axis = rng.normal(size=3)
    turn = cv2.Rodrigues(np.radians(degrees) * axis / np.linalg.norm(axis))[0]
    assert rotation_error(turn @ true, true) == pytest.approx(degrees, abs=1e-6)
    assert rotation_error(true, turn @ true) == pytest.approx(degrees, abs=1e-6)


@pytest.mark.parametrize("degrees", [0, 1e-4, 45, 135, 180])
def test_translations_differ_by_their_angle_whatever_their_lengths(degrees: float) -> None:
    angle = np.radians(degrees)
    estimated = 0.1 * np.array([np.cos(angle), 0, np.sin(angle)])
    assert translation_error(estimated, np.array([7.0, 0, 0])) == pytest.approx(degrees, abs=1e-9)


def test_without_a_true_translation_there_is_no_error_of_its_direction() -> None:
    assert translation_error(np.array([0, 0, 1.0]), np.zeros(3)) == 0


@pytest.mark.parametrize(
    ("errors", "threshold", "expected"),
    [
        # Under the line from (0, 0) to (2, 1), then at 1 up to 5: 1 + 3 of 5.
        ([2.0], 5.0, 0.8),
        # (0, 0), (1, 1/4), (3, 2/4), then level to 4: .125 + .75 + .5 of 4.
        ([1.0, 3.0, INF, INF], 4.0, 0.34375),
        # Level at 0 to 4, as the next point is beyond: the curve is cut, not interpolated.
        ([6.0, 8.0], 4.0, 0.0),
        ([0.0, 0.0], 5.0, 1.0),
        ([INF, INF], 5.0, 0.0),
        ([], 5.0, 0.0),
        # The order is of no importance: (0, 0), (0, 1/3), (10, 2/3), level to 20.
        ([10.0, INF, 0.0], 20.0, (10 * 0.5 + 10 * 2 / 3) / 20),
    ],
)
def test_the_auc_is_that_of_superglue(errors: list[float], threshold: float, expected) -> None:
    assert pose_auc(errors, threshold) == pytest.approx(expected)


def superglue_auc(errors: np.ndarray, threshold: float) -> float:
    """The published procedure, written again."""
    ordered = [0.0, *sorted(errors)]
    recall = [k / len(errors) for k in range(len(ordered))]
    last = sum(error < threshold for error in ordered)
    x, y = [*ordered[:last], threshold], [*recall[:last], recall[last - 1]]
    steps = zip(x, x[1:], y, y[1:], strict=False)
    return sum((b - a) * (low + high) / 2 for a, b, low, high in steps) / threshold


def test_the_auc_of_many_errors_is_near_the_exact_area() -> None:
    errors = np.random.default_rng(0).gamma(1.0, 6.0, 500)
    for threshold in (5.0, 10.0, 20.0):
        found = pose_auc(errors.tolist(), threshold)
        assert found == pytest.approx(superglue_auc(errors, threshold))
        exact = area_under_curve(errors.tolist(), threshold)
        assert exact < found < exact + 1 / 500


def test_agreement_is_sampsons_distance() -> None:
    """A camera moves to the right, so lines are rows: both points share the shift across them."""
    rows = np.array([[0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    points = np.full((4, 2), 9.0)
    moved = points + [[5, 0], [-7, 1.41], [0, 1.42], [3, -2]]
    assert epipolar_inlier_ratio(points, moved, rows) == 0.5
    assert epipolar_inlier_ratio(points, moved, rows, threshold_px=2.0) == 1.0
    assert epipolar_inlier_ratio(points[:0], moved[:0], rows) == 0
