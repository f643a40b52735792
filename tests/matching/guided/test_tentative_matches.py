from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from deepdetect import Keypoints, PointDetector
from deepdetect.geometry import transform_points
from deepdetect.io.image import luma
from deepdetect.matching.guided import guided_matches, guiding_geometry
from deepdetect.matching.guided import tentative_matches as module
from deepdetect.matching.guided.tentative_matches import matches_of_points

TURNED = np.vstack([cv2.getRotationMatrix2D((128, 128), 30, 1.2), [0, 0, 1]])


@pytest.fixture(autouse=True)
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hundred points are enough."""
    monkeypatch.setattr(module, "MIN_POINTS", 100)


@pytest.fixture(scope="module")
def pair(photo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    second = cv2.warpPerspective(photo, TURNED, (256, 256), flags=cv2.INTER_CUBIC)
    return photo, cv2.GaussianBlur(second, (0, 0), 1.2)


@pytest.fixture(scope="module")
def points(pair: tuple[np.ndarray, np.ndarray]) -> tuple[Keypoints, Keypoints]:
    detector = PointDetector(400)
    first, second = (detector.detect(image) for image in pair)
    return first, second


def test_points_match_at_their_own_sizes_and_angles(pair, points) -> None:
    found = matches_of_points((luma(pair[0]), luma(pair[1])), points)
    errors = np.linalg.norm(transform_points(found.points0, TURNED) - found.points1, axis=1)
    assert len(errors) > 60
    assert (errors < 3).mean() > 0.9


def test_of_a_large_image_they_are_scaled(pair, points, monkeypatch) -> None:
    grays = luma(pair[0]), luma(pair[1])
    monkeypatch.setattr(module, "MAX_SIDE_PX", 128)
    found = matches_of_points(grays, points)
    assert found.scales == (0.5, 0.5)
    assert found.features[0].xy.max() < 128
    assert found.features[0].image_size == found.views[0].shape == (128, 128)
    assert len(found.points0) > 50
    offsets = np.linalg.norm(found.points0[:, None] - points[0].xy, axis=2)
    assert offsets.min(axis=1).max() < 0.01


def test_too_few_or_plain_keypoints_are_not_taken(pair, points, monkeypatch) -> None:
    grays = luma(pair[0]), luma(pair[1])
    plain = tuple(replace(each, sizes=None) for each in points)
    assert matches_of_points(grays, plain) is None
    monkeypatch.setattr(module, "MIN_POINTS", 401)
    assert matches_of_points(grays, points) is None


def test_guided_matching_begins_with_points(pair, points, monkeypatch) -> None:
    grays = luma(pair[0]), luma(pair[1])
    places = np.rint(points[0].xy), np.rint(points[1].xy)
    with monkeypatch.context() as patched:
        patched.setattr(module, "detect_sift", None)
        first = guiding_geometry(grays, source=points)
        guide, found = guided_matches(grays, places, first)
    assert guide.model == "homography"
    errors = np.linalg.norm(
        transform_points(places[0][found.indices0], TURNED) - found.points1, axis=1
    )
    assert (errors < 1.5).mean() > 0.95


def test_where_points_give_nothing_sift_is_tried(pair, points) -> None:
    grays = luma(pair[0]), luma(pair[1])
    shuffled = np.random.default_rng(0).permutation(len(points[1]))
    wrong = replace(points[1], xy=points[1].xy[shuffled][:, ::-1])
    found, plain = (guiding_geometry(grays, source=one) for one in ((points[0], wrong), None))
    assert found.matrix is not None
    np.testing.assert_array_equal(found.matrix, plain.matrix)
