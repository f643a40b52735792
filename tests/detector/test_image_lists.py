from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from deepdetect import DeepDetect, ImageError, Keypoints, OptionError
from deepdetect.features.selection import SelectionOptions, select_keypoints


@pytest.fixture(scope="module")
def detector() -> DeepDetect:
    return DeepDetect(backend="onnxruntime")


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


@pytest.mark.parametrize(
    "options", [{}, {"max_keypoints": 50}, {"density": 0.1, "subpixel": True}], ids=str
)
@pytest.mark.parametrize("kind", [list, tuple])
def test_a_list_gives_what_its_images_give(
    detector: DeepDetect, images: list[np.ndarray], options: dict[str, Any], kind: type
) -> None:
    found = detector.detect(kind(images), **options)
    assert isinstance(found, list)
    assert len(found) == 3
    for keypoints, image in zip(found, images, strict=True):
        same(keypoints, detector.detect(image, **options))


def test_batches_of_either_layout(detector: DeepDetect, images: list[np.ndarray]) -> None:
    torch = pytest.importorskip("torch", reason="needs torch for its tensors")
    batch = np.stack([images[0], images[2]])
    expected = [detector.detect(image) for image in batch]
    first = np.ascontiguousarray(batch.transpose(0, 3, 1, 2))
    for given in (batch, first, torch.tensor(batch), torch.tensor(first) / 255):
        found = detector.detect(given)
        for keypoints, one in zip(found, expected, strict=True):
            same(keypoints, one)
    (only,) = detector.detect(first[:1])
    same(only, expected[0])


def test_heat_maps_of_a_list(detector: DeepDetect, images: list[np.ndarray]) -> None:
    maps = detector.heatmap(images)
    keypoints, others = detector.detect(images, return_heatmap=True)
    assert [map_.shape for map_ in maps] == [image.shape[:2] for image in images]
    for map_, other, image, points in zip(maps, others, images, keypoints, strict=True):
        one, expected = detector.detect(image, return_heatmap=True)
        assert map_.tobytes() == other.tobytes() == expected.tobytes()
        same(points, one)


def test_files_and_arrays_may_be_mixed(
    detector: DeepDetect, images: list[np.ndarray], tmp_path: Path
) -> None:
    path = tmp_path / "one.png"
    Image.fromarray(images[1]).save(path)
    found = detector.detect([path, images[0], Image.fromarray(images[1])], max_keypoints=20)
    same(found[0], found[2])
    same(found[1], detector.detect(images[0], max_keypoints=20))


def test_no_image_gives_nothing(detector: DeepDetect) -> None:
    assert detector.detect([]) == []
    assert detector.heatmap(()) == []
    assert detector.detect([], return_heatmap=True) == ([], [])


def test_rows_of_numbers_are_one_image(detector: DeepDetect, images: list[np.ndarray]) -> None:
    gray = images[0][..., 0]
    same(detector.detect((gray / 255).tolist()), detector.detect(gray / 255))


def test_a_bad_image_of_a_list_is_named(detector: DeepDetect, images: list[np.ndarray]) -> None:
    with pytest.raises(ImageError, match=r"^images\[1\]: the image is 5x5 pixels"):
        detector.detect([images[0], np.zeros((5, 5), np.uint8)])
    with pytest.raises(FileNotFoundError, match=r"^images\[2\]: there is no file missing.png"):
        detector.detect([*images[:2], "missing.png"])


def test_masks_of_a_list(detector: DeepDetect, images: list[np.ndarray]) -> None:
    masks = [np.zeros(image.shape[:2], bool) for image in images]
    for mask, column in zip(masks, (10, 20, 30), strict=True):
        mask[:, :column] = True
    found = detector.detect(images, ignore=masks)
    for keypoints, image, mask in zip(found, images, masks, strict=True):
        same(keypoints, detector.detect(image, ignore=mask))
    same(detector.detect(images, ignore=[None, None, masks[2]])[2], found[2])
    pair = [images[0], images[2]]
    for given in (masks[0], np.stack([masks[0], masks[0]])):
        both = detector.detect(pair, ignore=given)
        assert [keypoints.xy[:, 0].min() >= 10 for keypoints in both] == [True, True]
    with pytest.raises(OptionError, match="2 masks for 3 images"):
        detector.detect(images, ignore=masks[:2])
    with pytest.raises(OptionError, match=r"images\[1\]: the ignore mask has shape"):
        detector.detect(images, ignore=masks[0])


def test_images_of_opencv(detector: DeepDetect, images: list[np.ndarray]) -> None:
    rgb = images[0]
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    for options in ({}, {"max_keypoints": 30}):
        same(detector.detect(bgr, channels="bgr", **options), detector.detect(rgb, **options))
        (found,) = detector.detect([bgr], channels="bgr", **options)
        same(found, detector.detect(rgb, **options))
    for one, other in zip(
        detector.heatmap_and_logits(bgr, channels="bgr"),
        detector.heatmap_and_logits(rgb),
        strict=True,
    ):
        np.testing.assert_array_equal(one, other)
    assert (detector.heatmap(bgr) != detector.heatmap(rgb)).any()


@pytest.mark.parametrize("resolution", ["auto", "native", 64])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"threshold": 0.7},
        {"density": 0.2},
        {"nms_radius": 2},
        {"subpixel": True},
        {"max_keypoints": 40, "mode": "dense"},
        {"max_keypoints": 40, "nms_radius": 3},
        {"max_keypoints": 40, "threshold": 0.3, "subpixel": False},
        {"mode": "dense"},
    ],
    ids=str,
)
def test_a_kept_heat_map_is_selected_from_again(
    detector: DeepDetect, images: list[np.ndarray], resolution: Any, options: dict[str, Any]
) -> None:
    seen = DeepDetect(backend="onnxruntime", resolution=resolution)
    mask = np.zeros(images[1].shape[:2], bool)
    mask[:, 40:] = True
    heatmap, logits = seen.heatmap_and_logits(images[1])
    for ignore in (None, mask):
        expected = seen.detect(images[1], ignore=ignore, **options)
        again = {name: value for name, value in options.items() if name != "mode"}
        same(select_keypoints(heatmap, logits=logits, ignore=ignore, **again), expected)
        chosen = SelectionOptions(ignore=ignore, **options)
        same(select_keypoints(heatmap, chosen, logits), expected)


def test_a_heat_map_has_no_points(detector: DeepDetect, one_line) -> None:
    heatmap = np.zeros((20, 20), np.float32)
    for options in (
        SelectionOptions(mode="points"),
        SelectionOptions(max_keypoints=5, spread="grid"),
    ):
        with pytest.raises(OptionError, match="find points in the image") as caught:
            select_keypoints(heatmap, options)
        one_line(caught.value)


@pytest.mark.parametrize(
    ("image", "words"),
    [(None, "cv2.imread"), (iter([np.zeros((40, 40), np.uint8)]), "give a list")],
)
def test_what_is_no_image_is_named(detector: DeepDetect, image: object, words: str) -> None:
    with pytest.raises(ImageError, match=words):
        detector.detect(image)
