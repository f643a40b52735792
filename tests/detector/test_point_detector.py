from __future__ import annotations

import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest

from deepdetect import OptionError, PointDetector, WeightsError
from deepdetect.detector.points.detection import detect_points
from deepdetect.detector.points.ranker import load_ranker
from deepdetect.features.sift import scaled_sift_descriptors, to_root_sift


@pytest.fixture(scope="module")
def image(photo: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(photo[20:121, 60:197])


@pytest.fixture(scope="module")
def gray(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def test_it_finds_the_best_points(image: np.ndarray, gray: np.ndarray) -> None:
    for spread in ("none", "grid", "anms"):
        found = PointDetector(50.0, spread=spread).detect(image)
        np.testing.assert_array_equal(found.xy, detect_points(gray, 50, spread=spread).xy)
    assert len(PointDetector(None).detect(image)) == len(detect_points(gray))


def test_extracted_points_are_the_detected_ones_described(
    image: np.ndarray, gray: np.ndarray
) -> None:
    points = PointDetector(50, descriptor="rootsift")
    found, expected = points.extract(image), points.detect(image)
    np.testing.assert_array_equal(found.xy, expected.xy)
    sift = scaled_sift_descriptors(gray, expected.xy, expected.sizes, expected.angles)
    np.testing.assert_array_equal(found.descriptors, to_root_sift(sift))
    assert found.descriptor_type == "rootsift"


def test_a_ranker_of_ones_own_ranks(image: np.ndarray, tmp_path: Path) -> None:
    ranker = load_ranker()
    layers = [(np.zeros_like(weight), np.zeros_like(bias)) for weight, bias in ranker.layers]
    values = {f"weight{k}": weight for k, (weight, _) in enumerate(layers)}
    values |= {f"bias{k}": bias for k, (_, bias) in enumerate(layers)}
    path = tmp_path / "own.npz"
    np.savez(path, mean=ranker.mean, deviation=ranker.deviation, notes="{}", **values)
    own, bundled = PointDetector(40, ranker=path), PointDetector(40)
    found = own.detect(image)
    assert not np.array_equal(found.xy, bundled.detect(image).xy)
    # Nothing is added to the first feature: the logarithm of |det Hessian|.
    assert found.logits.max() <= 3
    other = pickle.loads(pickle.dumps(own))
    np.testing.assert_array_equal(other.detect(image).xy, found.xy)
    assert other.settings == own.settings != bundled.settings
    with pytest.raises(WeightsError, match=r"none\.npz"):
        PointDetector(ranker=tmp_path / "none.npz")


def test_points_of_large_images_are_found_on_two_megapixels(
    image: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = "deepdetect.detector.point_detector.MAX_AUTO_PIXELS"
    monkeypatch.setattr(name, image[..., 0].size // 4)
    whole = PointDetector(200, resolution="native").detect(image)
    half = PointDetector(100).detect(image)
    assert half.image_size == whole.image_size
    gaps = np.linalg.norm(half.xy[:, None] - whole.xy, axis=2)
    assert np.mean(gaps.min(1) < 1.5) > 0.5
    assert half.sizes.min() > 1.8 * whole.sizes.min()
    ignore = np.zeros(image.shape[:2], bool)
    ignore[:, : image.shape[1] // 2] = True
    found = PointDetector(50).detect(image, ignore=ignore)
    assert found.xy[:, 0].min() > image.shape[1] // 2 - 2


@pytest.mark.parametrize(
    "options",
    [
        {"max_keypoints": 0},
        {"max_keypoints": 10, "spread": "greedy"},
        {"max_keypoints": None, "spread": "grid"},
        {"resolution": 480},
        {"threshold": 0.5},
    ],
)
def test_wrong_options_are_reported(options: dict[str, object]) -> None:
    with pytest.raises(OptionError):
        PointDetector(**options)
