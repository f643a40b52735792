from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from deepdetect.io.image import luma
from deepdetect.labels import fuse


@pytest.fixture(scope="module")
def script(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("shifts_and_flips")


def pointwise(image: np.ndarray) -> np.ndarray:
    """A network that sees each pixel alone."""
    return image[..., 0].astype(float) - 128


def from_the_left(image: np.ndarray) -> np.ndarray:
    """A network that knows where the left border is."""
    return pointwise(image) + 8.0 * np.arange(image.shape[1])


@pytest.fixture
def image() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (200, 240, 3), np.uint8)


def test_a_pointwise_network_follows_everything(script: ModuleType, image: np.ndarray) -> None:
    label = image[..., 0] > 128
    found = script.shifts(pointwise, [(image, label)])
    assert found == (1, 1, 1, pytest.approx(label.mean()))
    assert script.flips(pointwise, [image]) == [1] * len(script.CHANGES)


def test_one_that_knows_the_border_does_not(script: ModuleType, image: np.ndarray) -> None:
    label = image[..., 0] > 128
    assert script.shifts(from_the_left, [(image, label)])[0] < 0.99
    mirrored, upside_down, *_ = script.flips(from_the_left, [image])
    assert mirrored < 0.99
    assert upside_down == 1


@pytest.mark.parametrize("change", [(flip, turns) for flip in (False, True) for turns in range(4)])
def test_changes_are_undone(script: ModuleType, image: np.ndarray, change: tuple) -> None:
    pixels = image[..., 0]
    np.testing.assert_array_equal(
        script.changed_back(script.changed(pixels, change), change), pixels
    )


def test_names_of_changes(script: ModuleType) -> None:
    pixels = np.arange(6).reshape(2, 3)
    expected = {
        "left-right": pixels[:, ::-1],
        "up-down": pixels[::-1],
        "90 degrees": np.rot90(pixels),
        "180 degrees": pixels[::-1, ::-1],
        "transposed": pixels.T,
    }
    for name, change in script.CHANGES.items():
        np.testing.assert_array_equal(script.changed(pixels, change), expected[name], err_msg=name)


def test_the_mean_of_eight_copies_follows_all_changes(
    script: ModuleType, image: np.ndarray
) -> None:
    mean = script.mean_of_copies(from_the_left, script.COPIES["mean of 8 copies"])
    square = np.ascontiguousarray(image[:, :200])
    assert min(script.flips(mean, [square])) > 0.999


def test_padding_is_cut_off_again(script: ModuleType, image: np.ndarray) -> None:
    np.testing.assert_array_equal(script.padded(pointwise, 16, "reflect")(image), pointwise(image))


def test_photographs_without_masks_get_labels(script: ModuleType, photo_path: Path) -> None:
    [(image, label)] = script.load(photo_path.parent, 1, 64)
    assert image.shape == (64, 64, 3)
    assert label.shape == (64, 64)
    assert label.dtype == bool


def test_labels_do_not_follow_shifts(script: ModuleType, photo: np.ndarray) -> None:
    label = fuse(luma(photo)).mask
    np.testing.assert_array_equal(script.label_logits(photo) > 0, label)
    overlap, far, labels, density = script.shifts(script.label_logits, [(photo, label)])
    assert 0.5 < overlap < 0.999
    assert 0.5 < far < 0.999
    assert labels == 1
    assert density == label.mean()
