from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from deepdetect import DeepDetect, OptionError, SelectionOptions
from deepdetect.detector.heatmap import HeatmapOptions
from deepdetect.detector.pretrained import pretrained_weights
from deepdetect.features.keypoints import Keypoints
from deepdetect.features.scale_space import dominant_angles
from deepdetect.features.sift import (
    root_sift_descriptors,
    scaled_sift_descriptors,
    sift_descriptors,
    to_root_sift,
)
from deepdetect.io.image import luma
from deepdetect_lab.evaluation.baselines.method import (
    COMMON_DESCRIPTOR,
    OwnScaleDescriptor,
    PointDescriptor,
    deepdetect_feature,
    with_common_descriptor,
    with_own_scale,
)
from deepdetect_lab.evaluation.baselines.opencv import CLASSICAL, STANDARD


@pytest.fixture(scope="module")
def crop(photo: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(photo[60:140, 100:200])


@pytest.fixture(scope="module")
def detector() -> DeepDetect:
    return DeepDetect(backend="onnxruntime", threads=1)


def test_points_equal_those_of_the_detector(detector: DeepDetect, crop: np.ndarray) -> None:
    method = deepdetect_feature(detector, SelectionOptions(0.4, max_keypoints=300, nms_radius=1))
    expected = detector.detect(crop, 0.4, max_keypoints=300, nms_radius=1)
    found = method.detect(crop)
    assert len(found) > 50
    np.testing.assert_array_equal(found.xy, expected.xy)
    np.testing.assert_array_equal(found.logits, expected.logits)
    assert found.image_size == (100, 80)


def test_descriptors_are_sift_of_size_3_with_the_angle_unset(
    detector: DeepDetect, crop: np.ndarray
) -> None:
    method = deepdetect_feature(detector)
    found = method.detect(crop).best(100)
    expected = sift_descriptors(luma(crop), found.xy, 3.0, -1.0)
    np.testing.assert_array_equal(method.describe(crop, found), expected)
    other = deepdetect_feature(detector, descriptor=PointDescriptor("rootsift", 4.0, 0.0))
    expected = root_sift_descriptors(luma(crop), found.xy, 4.0, 0.0)
    np.testing.assert_array_equal(other.describe(crop, found), expected)


def test_the_version_follows_all_that_the_points_depend_on(
    detector: DeepDetect, tmp_path: Path
) -> None:
    changed = tmp_path / "other.onnx"
    changed.write_bytes(pretrained_weights("dense").read_bytes())
    methods = [
        deepdetect_feature(detector),
        deepdetect_feature(detector, SelectionOptions(0.7)),
        deepdetect_feature(detector, SelectionOptions(nms_radius=1)),
        deepdetect_feature(detector.configured(HeatmapOptions(480))),
        deepdetect_feature(detector.configured(HeatmapOptions("native", "bgr"))),
        deepdetect_feature(DeepDetect(changed, backend="onnxruntime", threads=1)),
        deepdetect_feature(detector, descriptor=PointDescriptor(size_px=4.0)),
    ]
    assert len({method.version for method in methods}) == len(methods)
    again = deepdetect_feature(DeepDetect(backend="onnxruntime", threads=1))
    assert again.version == methods[0].version


def test_the_common_descriptor_replaces_any(photo: np.ndarray) -> None:
    crop = np.ascontiguousarray(photo[60:160, 60:160])
    for name in ("orb", "sift", "fast"):
        method = with_common_descriptor(CLASSICAL[name])
        assert not method.binary
        assert method.version != CLASSICAL[name].version
        found = method.detect(crop)[:40]
        expected = root_sift_descriptors(luma(crop), found.xy, 4.0, 0.0)
        np.testing.assert_array_equal(method.describe(crop, found), expected)
    assert PointDescriptor("rootsift", 4.0, 0.0) == COMMON_DESCRIPTOR


def test_own_sizes_and_angles_are_those_of_the_keypoints_or_the_gradients(crop: np.ndarray) -> None:
    gray = luma(crop)
    rng = np.random.default_rng(0)
    xy = rng.uniform(10, 70, (30, 2))
    sizes, angles = rng.uniform(3, 9, 30), rng.uniform(0, 360, 30)
    points = Keypoints(xy, np.ones(30), (100, 80), sizes=sizes, angles=angles)
    for factor in (1.0, 0.5):
        found = OwnScaleDescriptor(factor).describe(crop, points)
        by_hand = scaled_sift_descriptors(gray, points.xy, factor * points.sizes, points.angles)
        np.testing.assert_array_equal(found, to_root_sift(by_hand))
    turned = dataclasses.replace(points, angles=None)
    angles = dominant_angles(gray, points.xy, points.sizes)
    np.testing.assert_array_equal(
        OwnScaleDescriptor().describe(crop, turned),
        OwnScaleDescriptor().describe(crop, dataclasses.replace(points, angles=angles)),
    )
    # Where none is found there are no sizes.
    assert OwnScaleDescriptor().describe(crop, Keypoints.empty((100, 80))).shape == (0, 128)


def test_points_at_their_own_scale_are_those_of_the_common_row(crop: np.ndarray) -> None:
    common, own = (make(STANDARD["sift"]) for make in (with_common_descriptor, with_own_scale))
    with pytest.raises(OptionError):
        with_own_scale(CLASSICAL["fast"])
    assert common.detection == own.detection
    assert common.version != own.version
    np.testing.assert_array_equal(common.detect(crop).xy, own.detect(crop).xy)
    assert own.title == "SIFT, own size and angle"
    assert own.describe(crop, own.detect(crop)).shape == (len(own.detect(crop)), 128)
