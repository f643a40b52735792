from __future__ import annotations

import dataclasses
from typing import Any

import cv2
import numpy as np
import pytest

from deepdetect import (
    DeepDetect,
    Keypoints,
    Matches,
    OptionError,
    PointDetector,
    estimate_geometry,
    match_features,
)
from deepdetect.features.sift import describe_keypoints
from deepdetect.io.image import luma


@pytest.fixture(scope="module")
def pair(photo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return photo, np.ascontiguousarray(photo[5:, 9:])


@pytest.fixture(scope="module")
def features(pair: tuple[np.ndarray, np.ndarray]) -> list[Keypoints]:
    return [PointDetector(300).extract(image) for image in pair]


def test_points_match_by_their_descriptors(features: list[Keypoints]) -> None:
    found = match_features(*features)
    assert len(found) > 100
    assert (found.geometry, found.success, found.inliers.all()) == (None, True, True)
    np.testing.assert_array_equal(features[0].xy[found.indices0], found.points0)
    np.testing.assert_array_equal(features[1].xy[found.indices1], found.points1)
    errors = np.linalg.norm(found.points0 - (9, 5) - found.points1, axis=1)
    assert np.mean(errors < 1) > 0.95
    judged = found.with_geometry(estimate_geometry(found, model="homography"))
    assert judged.inliers.mean() > 0.95


def test_dense_features_match(pair) -> None:
    detector = DeepDetect(backend="onnxruntime")
    found = match_features(*(detector.extract(image, density=0.05) for image in pair))
    errors = np.linalg.norm(found.points0 - (9, 5) - found.points1, axis=1)
    assert len(found) > 500
    assert np.mean(errors < 1) > 0.8


def test_descriptors_that_cannot_be_compared_are_refused(features: list[Keypoints]) -> None:
    for changes in ({"descriptor_type": "sift"}, {"descriptors": features[1].descriptors[:, 32:]}):
        with pytest.raises(OptionError, match=r"types learned \(64 numbers\) and .* be compared"):
            match_features(features[0], dataclasses.replace(features[1], **changes))
    bare = dataclasses.replace(features[1], descriptors=None, descriptor_type=None)
    with pytest.raises(OptionError, match="no descriptors"):
        match_features(features[0], bare)


def test_matches_go_to_opencv(pair, features: list[Keypoints]) -> None:
    found = match_features(*features)
    keypoints = [each.to_opencv() for each in features]
    matches = found.to_opencv()
    np.testing.assert_array_equal([keypoints[0][m.queryIdx].pt for m in matches], found.points0)
    np.testing.assert_array_equal([keypoints[1][m.trainIdx].pt for m in matches], found.points1)
    drawn = cv2.drawMatches(pair[0], keypoints[0], pair[1], keypoints[1], matches, None)
    assert drawn.shape == (256, 256 + 247, 3)


class Fast:
    """OpenCV's FAST: keypoints with sizes, and with no angle of their own."""

    def detect(self, image: np.ndarray, ignore: object = None) -> Keypoints:
        gray = luma(image)
        found = cv2.FastFeatureDetector_create().detect(gray, None)
        return Keypoints.from_opencv(found, gray.shape[::-1])


def right_in_a_turned_image(found: Matches) -> np.ndarray:
    """Which matches of the photograph are where a quarter turn takes them."""
    x, y = found.points0.T
    return np.linalg.norm(np.column_stack([y, 255 - x]) - found.points1, axis=1) < 1


@pytest.mark.parametrize("descriptor", ["learned", "rootsift"])
def test_keypoints_without_angles_match_in_a_turned_image(
    photo: np.ndarray, descriptor: str
) -> None:
    assert (Fast().detect(photo).angles == -1).all()
    points = PointDetector(descriptor=descriptor)
    views = photo, np.ascontiguousarray(np.rot90(photo))
    found = match_features(*(points.describe(view, Fast().detect(view)) for view in views))
    assert len(found) > 1000
    assert right_in_a_turned_image(found).mean() > 0.9


def test_points_of_a_turned_image_match_by_their_angles(photo: np.ndarray) -> None:
    views = photo, np.ascontiguousarray(np.rot90(photo))
    found = match_features(*(PointDetector(300).extract(view) for view in views))
    assert len(found) > 60
    assert right_in_a_turned_image(found).mean() > 0.9


@pytest.fixture(scope="module")
def dense(pair) -> list[Keypoints]:
    """Every second pixel of both images, described as the pixels of a heat map are."""
    described = []
    for image in pair:
        gray = luma(image)
        xy = np.argwhere(np.ones_like(gray[::2, ::2]))[:, ::-1] * 2
        grid = Keypoints(xy, np.ones(len(xy)), gray.shape[::-1])
        described.append(describe_keypoints(gray, grid))
    return described


def test_mutual_matches_are_one_to_one(dense: list[Keypoints]) -> None:
    every, mutual = (match_features(*dense, matcher="exact", mutual=each) for each in (False, True))
    assert 0 < len(mutual) < len(every)
    assert len(np.unique(mutual.indices1)) == len(mutual)
    assert len(np.unique(every.indices1)) < len(every)


@pytest.mark.parametrize("matcher", ["flann", "exact"])
@pytest.mark.parametrize("count", [1, 3])
def test_very_few_keypoints(features: list[Keypoints], matcher: str, count: int) -> None:
    some = features[0][:count]
    found = match_features(some, some, matcher=matcher)
    assert len(found) == (0 if count == 1 else count)
    np.testing.assert_array_equal(found.points0, found.points1)


def test_descriptors_of_zeros_match_nothing() -> None:
    """All neighbours are at distance 0, and no ratio is under 1."""
    flat = np.full((20, 24), 90, np.uint8)
    xy = np.argwhere(flat)[:, ::-1]
    found = describe_keypoints(flat, Keypoints(xy, np.ones(480), (24, 20)))
    assert not found.descriptors.any()
    for matcher in ("flann", "exact"):
        assert len(match_features(found, found, matcher=matcher, ratio=1)) == 0


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"seed": 0.5}, "seed"),
        ({"matcher": "flan"}, "did you mean 'flann'"),
        ({"matcher": "hamming"}, "binary"),
        ({"matcher": "patchmatch"}, "dense keypoints of one scale and angle"),
        ({"ratio": 0}, "ratio"),
        ({"ratio": 1.01}, "ratio"),
        ({"mutal": True}, "did you mean 'mutual'"),
    ],
)
def test_wrong_options(features: list[Keypoints], values: dict[str, Any], words: str) -> None:
    with pytest.raises(OptionError, match=words):
        match_features(*features, **values)
