from __future__ import annotations

from pathlib import Path
from typing import Any

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
from deepdetect.detector.pretrained import pretrained_weights


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
    maps = detector.heatmap_batch(tuple(images))
    points = PointDetector(50).detect_batch(images)
    for k, image in enumerate(images):
        same(found[k], detector.detect(image, **options))
        assert maps[k].tobytes() == detector.heatmap(image).tobytes()
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


@pytest.mark.parametrize(
    ("backend", "tta"),
    [("onnxruntime", "none"), ("onnxruntime", "flip"), ("openvino", "none"), ("torch", "none")],
)
def test_images_of_one_size_are_run_together(photo: np.ndarray, backend: str, tta: Any) -> None:
    pytest.importorskip(backend)
    weights = "default" if backend != "torch" else pretrained_weights().with_suffix(".safetensors")
    detector = DeepDetect(weights, backend=backend, tta=tta, threads=1)
    shapes = count_runs(detector)
    pieces = [photo[y : y + 37, y : y + 51] for y in (0, 30, 60, 90, 120)]
    pieces[3] = np.full_like(pieces[3], 90)  # constant: the network is not run for it
    alone = [detector.heatmap(piece) for piece in pieces]
    shapes.clear()
    maps = detector.heatmap_batch(pieces, batch_size=3)
    sizes = [(40, 56)] if tta == "none" else [(40, 56), (56, 40)]
    assert {shape[2:] for shape in shapes} == set(sizes)
    assert [shape[0] for shape in shapes] == ([3, 1] if tta == "none" else [3] * 8 + [1] * 8)
    for map_, other in zip(maps, alone, strict=True):
        np.testing.assert_allclose(map_, other, atol=1e-4)
    assert not maps[3].any()


def test_sizes_agree_where_the_network_sees_them(photo: np.ndarray) -> None:
    """Squashed to a square, images of all sizes are run together; others only in their turn."""
    pieces = [photo[:80, :96], photo[:70, :110], photo[:80, :96]]
    for resolution, runs in ((64, [3]), ("native", [1, 1, 1])):
        detector = DeepDetect(backend="onnxruntime", resolution=resolution, threads=1)
        shapes = count_runs(detector)
        maps = detector.heatmap_batch(pieces, batch_size=4)
        assert [shape[0] for shape in shapes] == runs
        assert [map_.shape for map_ in maps] == [piece.shape[:2] for piece in pieces]
        np.testing.assert_allclose(maps[1], detector.heatmap(pieces[1]), atol=1e-5)


@pytest.mark.parametrize("backend", ["onnxruntime", "openvino"])
def test_a_network_for_one_image_names_the_way_out(
    photo: np.ndarray, backend: str, tmp_path: Path, one_line
) -> None:
    pytest.importorskip(backend)
    onnx = pytest.importorskip("onnx", reason="needs onnx to change a network")
    model = onnx.load_model(str(pretrained_weights()))
    model.graph.input[0].type.tensor_type.shape.dim[0].dim_value = 1
    onnx.save_model(model, str(tmp_path / "one.onnx"))
    detector = DeepDetect(tmp_path / "one.onnx", backend=backend, threads=1)
    pair = [photo[:64, :64], photo[64:128, :64]]
    assert len(detector.heatmap_batch(pair)) == 2
    with pytest.raises(DeepDetectError, match=r"2 images of 64x64 .*`batch_size=1`") as caught:
        detector.heatmap_batch(pair, batch_size=2)
    one_line(caught.value)
    assert len(detector.heatmap_batch(pair)) == 2


def count_runs(detector: DeepDetect) -> list[tuple[int, ...]]:
    """Let a detector write down the shape of each array that its network is given."""
    shapes: list[tuple[int, ...]] = []
    network = detector._network

    def counted(planes: np.ndarray) -> np.ndarray:
        shapes.append(planes.shape)
        return network(planes)

    detector._network = counted
    return shapes


def test_no_image_gives_nothing(detector: DeepDetect) -> None:
    assert detector.detect_batch([]) == PointDetector().detect_batch([]) == []
    assert detector.heatmap_batch(()) == []


def test_a_batch_is_no_single_image(detector: DeepDetect, images: list[np.ndarray]) -> None:
    for call in (detector.detect_batch, detector.heatmap_batch, PointDetector().detect_batch):
        with pytest.raises(OptionError, match="a batch is a list"):
            call(images[0])


def test_a_bad_image_of_a_list_is_named(detector: DeepDetect, images: list[np.ndarray]) -> None:
    with pytest.raises(ImageError, match=r"^images\[1\]: the image is 5x5 pixels"):
        detector.detect_batch([images[0], np.zeros((5, 5), np.uint8)])
    with pytest.raises(FileNotFoundError, match=r"^images\[2\]: there is no file missing.png"):
        detector.detect_batch([*images[:2], "missing.png"])


def test_lack_of_memory_for_a_map_is_one_sentence(detector, images, monkeypatch) -> None:
    monkeypatch.setattr("deepdetect.features.selection.Maps.both", lambda maps: bytearray(2**62))
    with pytest.raises(DeepDetectError, match="not enough memory for an image of"):
        detector.heatmap_batch(images)


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
    with pytest.raises(OptionError, match="2 masks for 3 images"):
        detector.detect_batch(images, ignore=masks[:2])
    with pytest.raises(OptionError, match=r"images\[1\]: the ignore mask must have the shape"):
        detector.detect_batch(images, ignore=masks[0])
