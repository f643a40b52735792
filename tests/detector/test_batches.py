from __future__ import annotations

import numpy as np
import pytest

from deepdetect import (
    DeepDetect,
    DeepDetectError,
    ImageError,
    Keypoints,
    OptionError,
    PointDetector,
)


@pytest.fixture(scope="module")
def detector() -> DeepDetect:
    return DeepDetect(backend="onnxruntime", threads=1)


@pytest.fixture(scope="module")
def images(photo: np.ndarray) -> list[np.ndarray]:
    """Pieces of a photograph, two of one size."""
    return [photo[:80, :96], photo[50:115, 20:101], photo[100:180, 100:196]]


def same(found: Keypoints, expected: Keypoints) -> None:
    for name in ("xy", "scores", "logits", "sizes", "angles"):
        one, other = getattr(found, name), getattr(expected, name)
        assert (one is None) == (other is None)
        assert one is None or one.tobytes() == other.tobytes()
    assert found.image_size == expected.image_size


def test_a_list_gives_what_its_images_give(detector: DeepDetect, images: list[np.ndarray]) -> None:
    options = {"density": 0.1, "subpixel": True}
    found = detector.detect_batch(images, **options)
    points = PointDetector(50).detect_batch(images)
    for k, image in enumerate(images):
        same(found[k], detector.detect(image, **options))
        same(points[k], PointDetector(50).detect(image))


def test_batches_of_either_layout(detector: DeepDetect, images: list[np.ndarray]) -> None:
    torch = pytest.importorskip("torch", reason="needs torch for its tensors")
    batch = np.stack([images[0], images[2]])
    expected = [detector.detect(image) for image in batch]
    first = np.ascontiguousarray(batch.transpose(0, 3, 1, 2))
    for given in (batch, first, torch.tensor(batch), torch.tensor(first) / 255):
        found = detector.detect_batch(given)
        for keypoints, one in zip(found, expected, strict=True):
            same(keypoints, one)
    (only,) = detector.detect_batch(first[:1])
    same(only, expected[0])


def test_no_image_gives_nothing(detector: DeepDetect) -> None:
    assert detector.detect_batch([]) == PointDetector().detect_batch([]) == []


def test_a_batch_is_no_single_image(detector: DeepDetect, images: list[np.ndarray]) -> None:
    for call in (detector.detect_batch, PointDetector().detect_batch):
        with pytest.raises(OptionError):
            call(images[0])


def test_a_bad_image_of_a_list_is_named(detector: DeepDetect, images: list[np.ndarray]) -> None:
    with pytest.raises(ImageError, match=r"images\[1\]"):
        detector.detect_batch([images[0], np.zeros((5, 5), np.uint8)])
    with pytest.raises(FileNotFoundError, match=r"missing\.png"):
        detector.detect_batch([*images[:2], "missing.png"])


def test_lack_of_memory_for_a_map_is_one_sentence(detector, images, monkeypatch) -> None:
    monkeypatch.setattr("deepdetect.features.selection.Maps.both", lambda maps: bytearray(2**62))
    with pytest.raises(DeepDetectError):
        detector.heatmap(images[0])


def test_masks_of_a_list(detector: DeepDetect, images: list[np.ndarray]) -> None:
    masks = [np.zeros(image.shape[:2], bool) for image in images]
    for mask, column in zip(masks, (10, 20, 30), strict=True):
        mask[:, :column] = True
    found = detector.detect_batch(images, ignore=masks)
    for keypoints, image, mask in zip(found, images, masks, strict=True):
        same(keypoints, detector.detect(image, ignore=mask))
    same(detector.detect_batch(images, ignore=[None, None, masks[2]])[2], found[2])
    pair = [images[0], images[2]]
    for given in (masks[0], np.stack([masks[0], masks[0]])):
        both = detector.detect_batch(pair, ignore=given)
        assert [keypoints.xy[:, 0].min() >= 10 for keypoints in both] == [True, True]
    with pytest.raises(OptionError):
        detector.detect_batch(images, ignore=masks[:2])
    with pytest.raises(OptionError, match=r"images\[1\]"):
        detector.detect_batch(images, ignore=masks[0])
