from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from deepdetect import OptionError, PointDetector
from deepdetect.features.sift import to_root_sift
from deepdetect.integrations.opencv import DeepDetectFeature2D

from .conftest import Views


@pytest.fixture(scope="module")
def bgr(views: Views) -> np.ndarray:
    return np.ascontiguousarray(views.first[:, :, ::-1])


def test_keypoints_are_those_of_the_detector(views: Views, bgr: np.ndarray) -> None:
    expected = PointDetector(200).detect(views.first)
    for image, channels in ((bgr, "bgr"), (views.first, "rgb")):
        keypoints = DeepDetectFeature2D(PointDetector(200), channels=channels).detect(image)
        assert np.array_equal([k.pt for k in keypoints], expected.xy)
        assert np.array_equal([k.size for k in keypoints], expected.sizes)
        assert np.array_equal([k.angle for k in keypoints], expected.angles)
        assert np.array_equal([k.response for k in keypoints], expected.scores)


@pytest.mark.parametrize("descriptor", ["learned", "rootsift"])
def test_both_steps_in_one_are_the_two_steps(bgr: np.ndarray, descriptor: Any) -> None:
    feature = DeepDetectFeature2D(PointDetector(200, descriptor=descriptor))
    both, descriptors = feature.detectAndCompute(bgr, None)
    keypoints, again = feature.compute(bgr, feature.detect(bgr))
    assert [k.pt for k in keypoints] == [k.pt for k in both]
    assert np.allclose(descriptors, again, atol=1e-5)
    assert descriptors.dtype == np.float32
    assert descriptors.shape == (len(both), feature.descriptorSize())
    assert feature.descriptorType() == cv2.SIFT_create().descriptorType()
    assert feature.defaultNorm() == cv2.SIFT_create().defaultNorm()
    assert not feature.empty()
    assert feature.getDefaultName() == "Feature2D.DeepDetect"


def test_sift_describes_our_keypoints_as_we_do(bgr: np.ndarray) -> None:
    detector = PointDetector(200, descriptor="rootsift")
    keypoints, ours = DeepDetectFeature2D(detector).detectAndCompute(bgr, None)
    gray = cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY)
    _, theirs = cv2.SIFT_create(enable_precise_upscale=True).compute(gray, keypoints)
    assert np.array_equal(to_root_sift(theirs.astype(np.uint8)), ours)


def test_we_describe_sifts_keypoints_as_it_does(bgr: np.ndarray) -> None:
    gray = cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY)
    keypoints, theirs = cv2.SIFT_create(100, enable_precise_upscale=True).detectAndCompute(
        gray, None
    )
    kept, ours = DeepDetectFeature2D(PointDetector(descriptor="rootsift")).compute(gray, keypoints)
    assert kept == tuple(keypoints)
    expected = to_root_sift(theirs.astype(np.uint8)).astype(np.float32)
    near = np.linalg.norm(ours - expected, axis=1)
    unrelated = np.linalg.norm(ours - np.roll(expected, 1, axis=0), axis=1)
    # Sizes between two layers are described at the nearest one, SIFT keeps the one it found.
    assert np.median(near) < 0.05 * np.median(unrelated)


def test_matches_of_two_views(views: Views, bgr: np.ndarray) -> None:
    feature = DeepDetectFeature2D(PointDetector(500))
    second = np.ascontiguousarray(views.second[:, :, ::-1])
    keypoints0, descriptors0 = feature.detectAndCompute(bgr, None)
    keypoints1, descriptors1 = feature.detectAndCompute(second, None)
    matcher = cv2.BFMatcher(feature.defaultNorm(), crossCheck=True)
    matches = matcher.match(descriptors0, descriptors1)
    points0 = np.array([keypoints0[m.queryIdx].pt for m in matches])
    points1 = np.array([keypoints1[m.trainIdx].pt for m in matches])
    assert len(matches) > 150
    assert views.correct(points0, points1) > 0.7
    assert len(cv2.FlannBasedMatcher().match(descriptors0, descriptors1)) == len(keypoints0)
    drawn = cv2.drawMatches(bgr, keypoints0, second, keypoints1, matches, None)
    assert drawn.shape == (200, 512, 3)


def test_a_mask_hides(bgr: np.ndarray) -> None:
    mask = np.zeros(bgr.shape[:2], np.uint8)
    mask[:, :100] = 255
    found = DeepDetectFeature2D(PointDetector(100)).detect(bgr, mask)
    assert found
    assert max(k.pt[0] for k in found) < 101


def test_nothing_to_detect_is_as_of_opencv() -> None:
    flat = np.full((64, 64), 90, np.uint8)
    assert DeepDetectFeature2D().detectAndCompute(flat, None) == ((), None)
    assert DeepDetectFeature2D().compute(flat, []) == ((), None)


def test_by_default_there_are_about_as_many_keypoints_as_of_sift(bgr: np.ndarray) -> None:
    count, sift = len(DeepDetectFeature2D().detect(bgr)), len(cv2.SIFT_create().detect(bgr))
    assert sift / 2 < count < 2 * sift
    assert len(DeepDetectFeature2D(max_keypoints=50).detect(bgr)) == 50
    few = DeepDetectFeature2D(PointDetector(80), max_keypoints=30)
    assert len(few.detectAndCompute(bgr)[0]) == 30
    with pytest.raises(OptionError):
        DeepDetectFeature2D(max_keypoints=0)
