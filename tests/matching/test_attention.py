from __future__ import annotations

import dataclasses
from typing import Any

import cv2
import numpy as np
import pytest
import skimage.data

from deepdetect import Keypoints, Matches, OptionError, PointDetector, match_features
from deepdetect.geometry.transforms import transfer_errors
from deepdetect.matching.attention import attention_inputs

OBLIQUE = np.array([[0.75, -0.12, 60], [0.1, 0.6, 30], [0.0006, 0.0002, 1]])
POINTS = PointDetector(700)


def view(photograph: np.ndarray, matrix: np.ndarray, light: float = 1.0) -> np.ndarray:
    warped = cv2.warpPerspective(photograph, matrix, (500, 420), flags=cv2.INTER_AREA)
    noise = np.random.default_rng(0).normal(0, 4, warped.shape)
    return np.clip(warped * light + noise, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def photograph() -> np.ndarray:
    return np.ascontiguousarray(skimage.data.coffee()[:400, 40:540])


@pytest.fixture(scope="module")
def pair(photograph: np.ndarray) -> tuple[Keypoints, Keypoints]:
    """Keypoints of a photograph, and of an oblique, dark and noisy view of it."""
    return POINTS.extract(photograph), POINTS.extract(view(photograph, OBLIQUE, 0.3))


def right(matches: Matches, matrix: np.ndarray) -> np.ndarray:
    return transfer_errors(matches.points0, matches.points1, matrix) < 3


def test_more_matches_are_right_than_by_the_ratio_test(pair: tuple[Keypoints, Keypoints]) -> None:
    found = right(match_features(*pair, filter_by="attention"), OBLIQUE)
    by_ratio = right(match_features(*pair), OBLIQUE)
    assert found.sum() > by_ratio.sum()
    assert found.mean() > 0.8


def test_likely_matches_are_right_more_often(pair: tuple[Keypoints, Keypoints]) -> None:
    matches = match_features(*pair, filter_by="attention")
    assert ((matches.scores > 0) & (matches.scores <= 1)).all()
    good = matches.scores > np.median(matches.scores)
    assert right(matches, OBLIQUE)[good].mean() > right(matches, OBLIQUE)[~good].mean()


def test_each_keypoint_matches_once_in_either_order(pair: tuple[Keypoints, Keypoints]) -> None:
    there = match_features(*pair, filter_by="attention")
    back = match_features(*pair[::-1], filter_by="attention").swapped()
    assert len(np.unique(there.indices0)) == len(np.unique(there.indices1)) == len(there)
    pairs = [set(zip(m.indices0, m.indices1, strict=True)) for m in (there, back)]
    assert len(pairs[0] & pairs[1]) > 0.9 * len(pairs[0] | pairs[1])


@pytest.mark.parametrize("degrees", [90, 150, 270])
def test_images_may_be_turned(photograph: np.ndarray, degrees: int) -> None:
    turn = np.vstack([cv2.getRotationMatrix2D((250, 200), degrees, 0.8), [0, 0, 1]])
    upright = POINTS.extract(view(photograph, np.diag([0.8, 0.8, 1])))
    turned = POINTS.extract(view(photograph, turn))
    first = POINTS.extract(photograph)
    found = right(match_features(first, turned, filter_by="attention"), turn).sum()
    expected = right(match_features(first, upright, filter_by="attention"), np.diag([0.8, 0.8, 1]))
    assert found > 0.6 * expected.sum()


def test_inputs_of_turned_keypoints_are_upright() -> None:
    rng = np.random.default_rng(0)
    described = rng.standard_normal((300, 64)).astype(np.float32)
    described /= np.linalg.norm(described, axis=1, keepdims=True)
    xy, angles = rng.uniform(0, 400, (300, 2)), rng.uniform(0, 360, 300)
    c, s = np.cos(np.radians(70)), np.sin(np.radians(70))
    common: dict[str, Any] = {
        "scores": np.ones(300),
        "sizes": np.full(300, 9.0),
        "image_size": (401, 401),
        "descriptors": described,  # turned to the keypoints' own angles, so that they are alike
        "descriptor_type": "learned",
    }
    first = Keypoints(xy=xy, angles=angles, **common)
    turned = (xy - 200) @ np.array([[c, s], [-s, c]]) + 200  # by 70 degrees from x to y
    inputs = attention_inputs(first, Keypoints(xy=turned, angles=(angles + 70) % 360, **common))
    for name in ("xy", "descriptors", "traits"):
        np.testing.assert_allclose(inputs[f"{name}1"], inputs[f"{name}0"], atol=2e-3)


def test_unrelated_images_hardly_match(pair: tuple[Keypoints, Keypoints]) -> None:
    other = POINTS.extract(np.ascontiguousarray(skimage.data.astronaut()))
    assert len(match_features(pair[0], other, filter_by="attention")) < 20


def test_no_keypoints_have_no_matches(pair: tuple[Keypoints, Keypoints]) -> None:
    for first, second in ((pair[0][:0], pair[1]), (pair[0], pair[1][:0])):
        assert len(match_features(first, second, filter_by="attention")) == 0


@pytest.mark.parametrize("backend", ["onnxruntime", "openvino"])
def test_both_runtimes_give_the_same_matches(
    pair: tuple[Keypoints, Keypoints], backend: str
) -> None:
    pytest.importorskip(backend)
    expected = match_features(*pair, filter_by="attention")
    found = match_features(*pair, filter_by="attention", backend=backend)
    pairs = [set(zip(m.indices0, m.indices1, strict=True)) for m in (found, expected)]
    assert len(pairs[0] & pairs[1]) > 0.99 * len(pairs[0] | pairs[1])


def test_what_does_not_suit_is_refused(pair: tuple[Keypoints, Keypoints]) -> None:
    first, second = pair
    for options in ({"ratio": 0.9}, {"mutual": False}, {"matcher": "flann"}):
        with pytest.raises(OptionError):
            match_features(first, second, filter_by="attention", **options)
    for changes in ({"sizes": None}, {"angles": None}):
        with pytest.raises(OptionError, match="sizes and angles"):
            match_features(dataclasses.replace(first, **changes), second, filter_by="attention")
    free = [dataclasses.replace(each, descriptor_type="learned-free") for each in pair]
    with pytest.raises(OptionError, match="type 'learned'"):
        match_features(*free, filter_by="attention")
