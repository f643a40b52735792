from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from deepdetect import Keypoints, PointDetector
from deepdetect.features.sift import describe_keypoints
from deepdetect.integrations.skimage import DeepDetectFeatures
from deepdetect.io.image import luma

from .conftest import Views

feature = pytest.importorskip("skimage.feature", reason="needs scikit-image")


def test_rows_come_before_columns(views: Views) -> None:
    expected = PointDetector(100).detect(views.first)
    features = DeepDetectFeatures(PointDetector(100))
    features.detect(views.first)
    assert features.descriptors is None
    assert np.array_equal(features.keypoints, expected.xy[:, ::-1])
    assert np.array_equal(features.scales, expected.sizes / 2)
    assert np.array_equal(features.orientations, np.deg2rad(expected.angles))
    assert np.array_equal(features.responses, expected.scores)
    features.extract(views.first)
    described = PointDetector(100).extract(views.first).descriptors
    assert np.abs(features.descriptors - described).max() < 1e-5  # angles in radians
    both = DeepDetectFeatures(PointDetector(100))
    both.detect_and_extract(views.first)
    assert np.array_equal(both.descriptors, described)


def test_a_bright_spot_is_found_in_its_row_and_column() -> None:
    image = np.zeros((60, 90))
    image[20, 70] = 1
    image = cv2.GaussianBlur(image, (0, 0), 3)
    features = DeepDetectFeatures(PointDetector(1))
    features.detect(image / image.max())
    assert features.keypoints == pytest.approx(np.array([[20, 70]]), abs=0.2)
    # Scikit-image finds it in the same place.
    assert feature.peak_local_max(image).tolist() == [[20, 70]]


def test_matches_of_two_views(views: Views) -> None:
    found = []
    for image in (views.first, views.second):
        features = DeepDetectFeatures(PointDetector(500))
        features.detect_and_extract(image)
        found.append(features)
    rows0, rows1 = feature.match_descriptors(
        found[0].descriptors, found[1].descriptors, max_ratio=0.8, cross_check=True
    ).T
    points0, points1 = found[0].keypoints[rows0, ::-1], found[1].keypoints[rows1, ::-1]
    assert len(rows0) > 100
    assert views.correct(points0, points1) > 0.9


def test_keypoints_of_scikit_images_corners_are_described(views: Views) -> None:
    gray = luma(views.first) / 255
    corners = feature.corner_peaks(feature.corner_harris(gray), min_distance=5)
    features = DeepDetectFeatures(PointDetector(descriptor="rootsift"))
    features.extract(gray, corners, scales=4.0)
    turned = feature.corner_orientations(gray, corners, np.ones((3, 3)))
    features_turned = DeepDetectFeatures(PointDetector(descriptor="rootsift"))
    features_turned.extract(gray, corners, 4.0, turned)
    count = len(corners)
    points = Keypoints(corners[:, ::-1], np.ones(count), (256, 200), sizes=np.full(count, 8.0))
    points = replace(points, angles=np.rad2deg(turned) % 360)
    expected = describe_keypoints(luma(views.first), points)
    assert features.descriptors.shape == (len(corners), 128)
    assert np.array_equal(features_turned.descriptors, expected.descriptors)
