from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect import Keypoints, OptionError, PointDetector
from deepdetect.features.sift import describe_keypoints
from deepdetect.io.image import luma

from .conftest import Views

torch = pytest.importorskip("torch", reason="needs torch")
lightglue = pytest.importorskip("deepdetect.integrations.lightglue")

POINTS = PointDetector(100, descriptor="rootsift")


def tensor(image: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(image.copy()).permute(2, 0, 1).float() / 255


def test_sift_keypoints_become_what_lightglues_extractor_makes_of_them(views: Views) -> None:
    """Its SIFT takes OpenCV's sizes and its angles in radians; RootSIFT is of length 1."""
    gray = luma(views.first)
    sift = cv2.SIFT_create(50, enable_precise_upscale=True)
    keypoints, descriptors = sift.detectAndCompute(gray, None)
    points = describe_keypoints(gray, Keypoints.from_opencv(keypoints, (256, 200)))
    features = points.to_lightglue()
    assert np.array_equal(features["keypoints"][0], [k.pt for k in keypoints])
    assert np.array_equal(features["scales"][0], np.float32([k.size for k in keypoints]))
    assert np.allclose(features["oris"][0], np.deg2rad([k.angle for k in keypoints]))
    assert features["image_size"].tolist() == [[256, 200]]
    expected = np.sqrt(descriptors / np.abs(descriptors).sum(axis=1, keepdims=True))
    cosine = (features["descriptors"][0].numpy() * expected).sum(axis=1)
    assert np.median(cosine) > 0.99
    assert np.allclose(features["descriptors"][0].norm(dim=1), 1, atol=1e-6)
    sigma = points.to_lightglue(scale="sigma")["scales"]
    assert np.array_equal(2 * sigma, features["scales"])


def test_the_extractor_gives_points(views: Views) -> None:
    expected = PointDetector(100).detect(views.first)
    features = lightglue.DeepDetectExtractor(POINTS).extract(tensor(views.first))
    assert {name: tuple(value.shape) for name, value in features.items()} == {
        "keypoints": (1, 100, 2),
        "keypoint_scores": (1, 100),
        "descriptors": (1, 100, 128),
        "scales": (1, 100),
        "oris": (1, 100),
        "image_size": (1, 2),
    }
    assert {value.dtype for value in features.values()} == {torch.float32}
    assert np.array_equal(features["keypoints"][0], expected.xy)
    for image in (views.first, tensor(views.first)[None]):
        again = lightglue.DeepDetectExtractor(POINTS).extract(image)
        assert all(torch.equal(again[name], features[name]) for name in features)


def test_descriptors_without_weights_are_refused() -> None:
    with pytest.raises(OptionError, match="rootsift"):
        lightglue.DeepDetectExtractor(PointDetector(100))


def test_scales_and_angles_are_as_kornia_makes_them_of_frames(views: Views) -> None:
    """Kornia gives LightGlue a sixth of the scale of its frames, and the negative angle."""
    feature = pytest.importorskip("kornia.feature", reason="needs kornia")
    from deepdetect.integrations.kornia import DeepDetectDetector

    lafs, _ = DeepDetectDetector(PointDetector(100))(tensor(views.first)[None])
    features = lightglue.DeepDetectExtractor(POINTS, scale="sigma").extract(tensor(views.first))
    assert torch.allclose(features["scales"], feature.get_laf_scale(lafs)[..., 0, 0] / 6)
    turned = torch.deg2rad(feature.get_laf_orientation(lafs)[..., 0]) + features["oris"]
    assert torch.allclose(torch.cos(turned), torch.ones(1), atol=1e-5)
