from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
import skimage.data

from deepdetect import Keypoints, OptionError, PointDetector, match_features


@pytest.fixture(scope="module")
def features() -> tuple[Keypoints, Keypoints]:
    first = np.ascontiguousarray(skimage.data.coffee()[:300, :400])
    turn = cv2.getRotationMatrix2D((200, 150), 40, 1.1)
    second = cv2.warpAffine(first, turn, (400, 300))
    points = PointDetector(700)
    return points.extract(first), points.extract(second)


@pytest.mark.parametrize("backend", ["onnxruntime", "openvino"])
@pytest.mark.parametrize(
    "options", [{}, {"mutual": False}, {"ratio": 0.8}, {"filter_by": "neighbours"}]
)
def test_matches_are_those_of_exact_search(
    features: tuple[Keypoints, Keypoints], backend: str, options: dict[str, Any]
) -> None:
    pytest.importorskip(backend)
    found = match_features(*features, backend=backend, **options)
    expected = match_features(*features, matcher="exact", **options)
    assert len(expected) > 100
    np.testing.assert_array_equal(found.indices0, expected.indices0)
    np.testing.assert_array_equal(found.indices1, expected.indices1)
    np.testing.assert_allclose(found.scores, expected.scores, atol=1e-3)


def test_nothing_matches_too_few_keypoints(features: tuple[Keypoints, Keypoints]) -> None:
    first, second = features
    assert len(match_features(first[:0], second, backend="onnxruntime")) == 0
    assert len(match_features(first, second[:1], backend="onnxruntime")) == 0


def test_what_a_graph_cannot_match_is_refused(features: tuple[Keypoints, Keypoints]) -> None:
    with pytest.raises(OptionError, match="exact search"):
        match_features(*features, backend="onnxruntime", matcher="flann")
    with pytest.raises(OptionError, match="device"):
        match_features(*features, device="CUDAExecutionProvidr")
    with pytest.raises(OptionError, match="backend"):
        match_features(features[0][:0], features[1], backend="nonsense")
    points = PointDetector(50, descriptor="rootsift")
    found = points.extract(skimage.data.coffee())
    with pytest.raises(OptionError, match="learned"):
        match_features(found, found, backend="onnxruntime")
