"""Matching by rectification: a real pair with known disparities, as it is and moved."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from deepdetect.features.matches import GuidedMatches
from deepdetect.geometry import epipolar_errors, transform_points
from deepdetect.io.image import luma
from deepdetect.matching.guided import ImagePair, Sources, along_rows
from deepdetect.matching.guided.along_rows import match_by_rectification
from deepdetect.matching.guided.proposals import Hypothesis, propose
from deepdetect_lab.datasets.middlebury import load_middlebury

TURNED = cv2.getRotationMatrix2D((225, 190), 30, 1.0)


@pytest.fixture(scope="module")
def cones(shared: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    pair = load_middlebury(shared / "data" / "middlebury" / "cones")
    left, right, disparity = (view[120:] for view in (pair.left, pair.right, pair.disparity))
    return luma(left), luma(right), disparity


@pytest.fixture(scope="module")
def first(cones) -> Hypothesis:
    return lines(cones[0], cones[1])


@pytest.fixture(scope="module")
def found(cones, first) -> GuidedMatches:
    """The matches of every second keypoint."""
    matches = match(*cones[:2], every_second(cones[0]), first)
    return matches


def lines(gray0: np.ndarray, gray1: np.ndarray) -> Hypothesis:
    """Return the fundamental matrix that learned matches propose."""
    pair = ImagePair((gray0, gray1))
    found = propose(pair, Sources(pair).learned, "fundamental", 0)
    assert found is not None
    return found


def match(
    gray0: np.ndarray, gray1: np.ndarray, xy0: np.ndarray, first: Hypothesis
) -> GuidedMatches | None:
    found = match_by_rectification((gray0, gray1), xy0, first.points, first.matrix)
    return None if found is None else found[1]


def every_second(gray: np.ndarray) -> np.ndarray:
    y, x = np.mgrid[: gray.shape[0] : 2, : gray.shape[1] : 2]
    return np.column_stack([x.ravel(), y.ravel()]).astype(np.float32)


def within(found: GuidedMatches, xy0: np.ndarray, cones, move: np.ndarray) -> float:
    """Return the share of the matches with a true place that are within a pixel of it."""
    x, y = xy0[found.indices0].astype(int).T
    disparity = cones[2][y, x]
    true = transform_points(np.column_stack([x - disparity, y]), np.vstack([move, [0, 0, 1]]))
    errors = np.linalg.norm(true - found.points1, axis=1)
    return float((errors[np.isfinite(errors)] < 1).mean())


@pytest.mark.parametrize(
    ("move", "precision"),
    [
        (None, 0.97),
        (TURNED, 0.93),
        (np.float64([[0.8, 0, 30], [0, 0.8, 20]]), 0.85),
    ],
    ids=["rectified", "rotated", "zoomed"],
)
def test_most_keypoints_are_matched_and_right(cones, found, move, precision: float) -> None:
    left, right, _ = cones
    xy0 = every_second(left)
    if move is None:
        move = np.eye(2, 3)
    else:
        second = cv2.warpAffine(right, move, right.shape[::-1], flags=cv2.INTER_CUBIC)
        found = match(left, second, xy0, lines(left, second))
    assert len(found) > 0.35 * len(xy0)
    assert within(found, xy0, cones, move) > precision
    assert ((found.scores >= 0) & (found.scores <= 1)).all()
    assert (np.diff(found.indices0) > 0).all()


def test_a_pair_with_too_much_to_search_is_matched_on_smaller_copies(
    cones, first, monkeypatch
) -> None:
    left, right, _ = cones
    xy0 = every_second(left)
    monkeypatch.setattr(along_rows, "MAX_VOLUME", 3e6)
    found = match(left, right, xy0, first)
    assert len(found) > 0.25 * len(xy0)
    move = np.float64([[1, 0, 0], [0, 1, 0]])
    assert within(found, xy0, cones, move) > 0.85


def test_a_matrix_that_is_off_is_corrected(cones, first) -> None:
    """One that is turned by a third of a degree about the middle of the image."""
    left, right, _ = cones
    turn = np.vstack([cv2.getRotationMatrix2D((225, 190), 0.3, 1), [0, 0, 1]])
    wrong = np.linalg.inv(turn).T @ first.matrix
    xy0 = every_second(left)
    found = match_by_rectification((left, right), xy0, first.points, wrong)
    matrix, matches = found
    assert epipolar_errors(xy0[matches.indices0], matches.points1, matrix).max() < 1e-6
    rows = np.abs(matches.points1[:, 1] - xy0[matches.indices0, 1])
    assert np.quantile(rows, 0.9) < 0.25


def test_matches_that_the_sparse_ones_contradict_do_not_count(cones, first) -> None:
    """Sparse matches that lie on the right lines, but at other places of them."""
    left, right, _ = cones
    points0, points1 = first.points
    astray = points1.copy()
    astray[::2, 0] -= 8
    given = (left, right), every_second(left), (points0, astray), first.matrix
    assert match_by_rectification(*given) is None


def test_without_tracked_corners_no_match_counts(cones, first, found, monkeypatch) -> None:
    gray0, gray1, _ = cones
    assert len(found) > 0
    monkeypatch.setattr(along_rows, "MIN_TRACKS", 1_000_000)
    assert match(gray0, gray1, every_second(gray0), first) is None
