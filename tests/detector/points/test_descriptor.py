from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import deepdetect
from deepdetect import Keypoints, OptionError, PointDetector
from deepdetect.detector.points.descriptor import describe_learned
from deepdetect.features.scale_space import dominant_angles
from deepdetect.io.image import luma


def learned(image: np.ndarray) -> Keypoints:
    return PointDetector(300).extract(image)


def test_descriptors_of_length_one_belong_to_the_detected_points(photo: np.ndarray) -> None:
    found, detected = learned(photo), PointDetector(300).detect(photo)
    np.testing.assert_array_equal(found.xy, detected.xy)
    assert found.descriptors is not None
    assert (found.descriptors.shape, found.descriptor_type) == ((300, 64), "learned")
    np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1, atol=1e-5)


def test_rows_do_not_depend_on_each_other(photo: np.ndarray) -> None:
    gray, found = photo[:, :, 1], learned(photo)
    alone = describe_learned(gray, found[7:8]).descriptors
    np.testing.assert_allclose(describe_learned(gray, found).descriptors[7:8], alone, atol=1e-5)


@pytest.mark.parametrize("quarter_turns", range(4))
def test_points_of_a_darkened_turned_image_are_matched(
    photo: np.ndarray, quarter_turns: int
) -> None:
    side = min(photo.shape[:2])
    square = photo[:side, :side]
    other = np.ascontiguousarray(np.rot90(square, -quarter_turns)) // 3 + 20  # clockwise
    matches = deepdetect.match_features(learned(square), learned(other), ratio=1)
    x, y = matches.points0.T
    for _ in range(quarter_turns):
        x, y = side - 1 - y, x
    right = np.hypot(*(np.stack([x, y], 1) - matches.points1).T) < 3
    assert right.sum() > 150


def test_other_descriptors_cannot_be_compared(photo: np.ndarray) -> None:
    other = PointDetector(300, descriptor="rootsift").extract(photo)
    with pytest.raises(OptionError):
        deepdetect.match_features(learned(photo), other)
    with pytest.raises(OptionError, match="rootsift"):
        PointDetector(descriptor="rootsfit")


def test_descriptors_of_a_turned_image_are_alike_in_any_program(photo: np.ndarray) -> None:
    side = min(photo.shape[:2])
    square = photo[:side, :side]
    first, second = learned(square), learned(np.ascontiguousarray(np.rot90(square)))
    alike = first.descriptors @ second.descriptors.T
    x, y = first.xy.T
    there = np.stack([y, side - 1 - x], 1)  # against the clock
    right = np.hypot(*(there - second.xy[alike.argmax(1)]).T) < 3
    assert right.mean() > 0.6


def test_unset_angles_become_dominant_ones(photo: np.ndarray) -> None:
    points, found = PointDetector(300), learned(photo)
    bare = dataclasses.replace(found, angles=None, descriptors=None)
    again = points.describe(photo, bare)
    dominant = dominant_angles(luma(photo), found.xy, found.sizes)
    np.testing.assert_array_equal(again.angles, dominant)
    turns = (again.angles - found.angles + 180) % 360 - 180
    assert np.median(np.abs(turns)) < 2
    near = np.sum(again.descriptors * found.descriptors, 1)
    assert np.median(near) > 0.99
    with pytest.raises(OptionError):
        points.describe(photo, dataclasses.replace(bare, sizes=None))


@pytest.mark.parametrize("quarter_turns", range(4))
def test_cross_modal_descriptors_match_a_turned_negative(
    photo: np.ndarray, quarter_turns: int
) -> None:
    points = PointDetector(300, descriptor="cross-modal")
    side = min(photo.shape[:2])
    square = photo[:side, :side]
    first = points.extract(square)
    assert first.descriptor_type == "cross-modal"
    negative = np.ascontiguousarray(np.rot90(255 - square, -quarter_turns))
    matches = deepdetect.match_features(first, points.extract(negative), ratio=1)
    x, y = matches.points0.T
    for _ in range(quarter_turns):
        x, y = side - 1 - y, x
    right = np.hypot(*(np.stack([x, y], 1) - matches.points1).T) < 3
    assert right.sum() > 150
