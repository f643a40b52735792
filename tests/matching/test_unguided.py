from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from deepdetect import (
    DeepDetect,
    Keypoints,
    MatchingOptions,
    OptionError,
    PointDetector,
    match_features,
    match_images,
)
from deepdetect.io.image import luma


@pytest.fixture(scope="module")
def pair(photo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return photo, np.ascontiguousarray(photo[5:, 9:])


@pytest.fixture(scope="module")
def features(pair: tuple[np.ndarray, np.ndarray]) -> list[Keypoints]:
    return [PointDetector(300).extract(image) for image in pair]


def test_features_match_as_images_do(pair, features: list[Keypoints]) -> None:
    found = match_features(*features)
    expected = match_images(
        *pair,
        PointDetector(300),
        guided_matching=False,
        model="none",
        mutual=True,
        options=MatchingOptions(matcher="auto", ratio=0.88),
    )
    assert len(found) > 100
    for name in ("points0", "points1", "scores", "inliers", "indices0", "indices1"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    errors = np.linalg.norm(found.points0 - (9, 5) - found.points1, axis=1)
    assert np.mean(errors < 1) > 0.95


def test_dense_features_match(pair) -> None:
    detector = DeepDetect(backend="onnxruntime")
    found = match_features(*(detector.extract(image, density=0.05) for image in pair))
    errors = np.linalg.norm(found.points0 - (9, 5) - found.points1, axis=1)
    assert len(found) > 500
    assert np.mean(errors < 1) > 0.8


def test_descriptors_that_cannot_be_compared_are_refused(features: list[Keypoints]) -> None:
    for changes in ({"descriptor_type": "sift"}, {"descriptors": features[1].descriptors[:, 32:]}):
        with pytest.raises(OptionError):
            match_features(features[0], dataclasses.replace(features[1], **changes))
    bare = dataclasses.replace(features[1], descriptors=None, descriptor_type=None)
    with pytest.raises(OptionError):
        match_features(features[0], bare)


def test_matches_go_to_opencv(pair, features: list[Keypoints]) -> None:
    found = match_features(*features)
    keypoints = [each.to_opencv() for each in features]
    matches = found.to_opencv()
    np.testing.assert_array_equal([keypoints[0][m.queryIdx].pt for m in matches], found.points0)
    np.testing.assert_array_equal([keypoints[1][m.trainIdx].pt for m in matches], found.points1)
    drawn = cv2.drawMatches(pair[0], keypoints[0], pair[1], keypoints[1], matches, None)
    assert drawn.shape == (256, 256 + 247, 3)


def test_the_matrix_has_the_name_of_its_model(pair) -> None:
    plane = match_images(*pair, PointDetector(300), model="homography")
    assert plane.homography is plane.matrix is not None
    assert plane.fundamental is None
    lines = dataclasses.replace(plane, model="fundamental")
    assert lines.fundamental is plane.matrix
    assert lines.homography is None


class Fast:
    """OpenCV's FAST: keypoints with sizes, and with no angle of their own."""

    def detect(self, image: np.ndarray, ignore: object = None) -> Keypoints:
        gray = luma(image)
        found = cv2.FastFeatureDetector_create().detect(gray, None)
        return Keypoints.from_opencv(found, gray.shape[::-1])


@pytest.mark.parametrize("descriptor", ["sift", "rootsift"])
def test_keypoints_without_angles_match_in_a_turned_image(
    photo: np.ndarray, descriptor: str
) -> None:
    assert (Fast().detect(photo).angles == -1).all()
    turned = np.ascontiguousarray(np.rot90(photo))
    found = match_images(
        photo,
        turned,
        Fast(),
        guided_matching=False,
        mutual=True,
        model="homography",
        options=MatchingOptions(descriptor=descriptor, ratio=0.85),
    )
    x, y = found.points0.T
    errors = np.linalg.norm(np.column_stack([y, 255 - x]) - found.points1, axis=1)
    assert np.count_nonzero(errors < 1) > 1000
    assert found.inliers.mean() > 0.95


def test_a_seed_that_is_no_whole_number_is_refused(features: list[Keypoints]) -> None:
    with pytest.raises(OptionError):
        match_features(*features, seed=0.5)
