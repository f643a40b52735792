from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial import KDTree

from deepdetect.geometry import transfer_errors, transform_points
from deepdetect.io.image import luma
from deepdetect.matching.guided import ImagePair
from deepdetect.matching.guided.along_plane import MAX_DISTANCE_PX as REACH
from deepdetect.matching.guided.along_plane import match_along_plane
from deepdetect.matching.guided.judge import Judge

SHIFT = np.array([[1.0, 0, 9], [0, 1, -6], [0, 0, 1]])
MILD = np.array([[0.95, -0.06, 15.0], [0.08, 0.97, -5.0], [1e-4, -1e-4, 1.0]])


def matched(
    gray0: np.ndarray, gray1: np.ndarray, xy0: np.ndarray, xy1: np.ndarray, homography: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    pair = ImagePair((gray0, gray1))
    judge = Judge(pair)
    evidence = judge.along_plane(homography).evidence
    found = match_along_plane(pair, (xy0, xy1), homography, judge, evidence)
    return found.indices0, found.indices1, found.scores


def every_pixel(gray: np.ndarray) -> np.ndarray:
    row, column = np.indices(gray.shape)
    return np.column_stack([column.ravel(), row.ravel()]).astype(np.float32)


def warped(gray: np.ndarray, homography: np.ndarray) -> np.ndarray:
    size = (gray.shape[1], gray.shape[0])
    return cv2.warpPerspective(gray, homography, size, flags=cv2.INTER_CUBIC)


def test_a_shift_by_whole_pixels_matches_each_pixel_with_its_own(photo: np.ndarray) -> None:
    gray = luma(photo)[:120, :160]
    xy = every_pixel(gray)
    rows0, rows1, _ = matched(gray, warped(gray, SHIFT), xy, xy, SHIFT)
    np.testing.assert_array_equal(xy[rows1], xy[rows0] + [9, -6])
    assert len(rows0) > 0.85 * (160 - 9) * (120 - 6)
    assert len(np.unique(rows0)) == len(rows0)


def test_matches_lie_within_reach_of_where_the_homography_takes_them(photo: np.ndarray) -> None:
    gray = luma(photo)
    generator = np.random.default_rng(0)
    xy0, xy1 = (
        every_pixel(gray)[np.sort(generator.permutation(gray.size)[:20_000])] for _ in range(2)
    )
    rows0, rows1, _ = matched(gray, warped(gray, MILD), xy0, xy1, MILD)
    errors = transfer_errors(xy0[rows0], xy1[rows1], MILD)
    assert errors.max() < REACH
    assert len(np.unique(rows0)) == len(rows0)
    # Nearly all that have a partner within reach and are seen.
    there = cv2.perspectiveTransform(xy0[None].astype(float), MILD)[0]
    inside = ((there > 2) & (there < 253)).all(1)
    partner = KDTree(xy1).query(there)[0] < REACH
    assert len(rows0) > 0.9 * np.count_nonzero(inside & partner)


def test_evidence_needs_no_keypoint_with_a_partner(photo: np.ndarray) -> None:
    """It is chance that none has one here: the images show the plane all the same."""
    gray = luma(photo)
    pair = ImagePair((gray, warped(gray, MILD)))
    xy0 = np.stack(np.meshgrid(np.arange(32, 224, 16), np.arange(32, 224, 16)), -1).reshape(-1, 2)
    xy1 = np.rint(transform_points(xy0, MILD)) + 4
    judge = Judge(pair)
    evidence = judge.along_plane(MILD).evidence
    assert len(match_along_plane(pair, (xy0, xy1), MILD, judge, evidence)) == 0
    assert evidence.share > 0.95


@pytest.mark.slow
def test_a_wrong_homography_matches_next_to_nothing(photo: np.ndarray) -> None:
    gray = luma(photo)
    xy = every_pixel(gray)
    wrong = SHIFT @ np.array([[0.0, -1, 255], [1, 0, 0], [0, 0, 1]])
    second = warped(gray, SHIFT)
    right = matched(gray, second, xy, xy, SHIFT)[0]
    assert len(matched(gray, second, xy, xy, wrong)[0]) < 0.05 * len(right)


@pytest.mark.parametrize(
    "homography",
    [
        np.array([[1.0, 0, 5000], [0, 1, 0], [0, 0, 1]]),  # nothing in common
        np.array([[1.0, 0, 0], [0, 1, 0], [-0.02, 0, 1]]),  # the horizon at x = 50
    ],
)
def test_a_homography_to_nowhere_is_taken(photo: np.ndarray, homography: np.ndarray) -> None:
    gray = luma(photo)[:100, :100]
    xy = every_pixel(gray)
    rows0, rows1, _ = matched(gray, gray, xy, xy, homography)
    assert len(rows0) == len(rows1) < 0.5 * len(xy)
    assert (transfer_errors(xy[rows0], xy[rows1], homography) < REACH).all()
