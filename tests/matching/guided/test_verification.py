from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from deepdetect.io.image import load_image, luma
from deepdetect.matching.guided import strangers
from deepdetect.matching.guided.strangers import BLOCK, BLOCKS
from deepdetect.matching.guided.verification import (
    STRANGERS,
    alike,
    unlikeness,
)

HALF = 128
REACH = 16
"""Pixels about an edge within which descriptors see both sides of it."""


@pytest.fixture(scope="module")
def picture() -> Callable[..., np.ndarray]:
    """One of scikit-image's photographs by its name, as luma of a given side."""
    data = pytest.importorskip("skimage.data", reason="needs scikit-image for its photographs")

    def read(name: str, side: int) -> np.ndarray:
        gray = luma(load_image(getattr(data, name)()))
        return cv2.resize(gray, (side, side), interpolation=cv2.INTER_AREA)

    return read


def every_pixel(gray: np.ndarray) -> np.ndarray:
    row, column = np.indices(gray.shape)
    return np.column_stack([column.ravel(), row.ravel()])


def edges(gray: np.ndarray) -> np.ndarray:
    """Pixels of contours: what dense keypoints lie on."""
    row, column = np.nonzero(cv2.Canny(gray, 60, 120))
    return np.column_stack([column, row])


def seen_again(gray: np.ndarray) -> np.ndarray:
    """The same scene in other light, with noise."""
    noise = np.random.default_rng(0).normal(0, 4, gray.shape)
    return np.clip(gray * 0.8 + 20 + noise, 0, 255).astype(np.uint8)


def everywhere(gray: np.ndarray) -> np.ndarray:
    return np.ones(gray.shape, bool)


def test_the_same_image_agrees_nearly_everywhere(photo: np.ndarray) -> None:
    gray = luma(photo)
    pixels = every_pixel(gray)
    assert alike(gray, gray, everywhere(gray), pixels).mean() > 0.99
    assert alike(gray, seen_again(gray), everywhere(gray), pixels).mean() > 0.95


@pytest.mark.parametrize("other", ["rocket", "coffee", "astronaut", "chelsea", "brick"])
@pytest.mark.parametrize("name", ["camera", "astronaut"])
def test_under_another_photograph_next_to_nothing_agrees(
    picture: Callable[..., np.ndarray], name: str, other: str
) -> None:
    """It is pasted over one quarter of the second image after the other."""
    if name == other:
        pytest.skip("the same photograph")
    gray, strange = picture(name, 2 * HALF), picture(other, HALF)
    pixels = edges(gray)
    under_it, others = [], []
    for top, left in ((0, 0), (0, HALF), (HALF, 0), (HALF, HALF)):
        second = seen_again(gray)
        second[top : top + HALF, left : left + HALF] = strange
        agreed = alike(gray, second, everywhere(gray), pixels)
        pasted = np.zeros(gray.shape, np.uint8)
        pasted[top : top + HALF, left : left + HALF] = 1
        kernel = np.ones((2 * REACH + 1, 2 * REACH + 1), np.uint8)
        inner, outer = cv2.erode(pasted, kernel), cv2.dilate(pasted, kernel)
        column, row = pixels.T
        under_it.append(agreed[inner[row, column] > 0])
        others.append(agreed[outer[row, column] == 0])
    assert np.concatenate(others).mean() > 0.95
    assert np.concatenate(under_it).mean() < STRANGERS


@pytest.mark.parametrize("name", ["astronaut", "camera", "coffee"])
def test_a_fiftieth_of_strangers_passes(picture: Callable[..., np.ndarray], name: str) -> None:
    """Of an image moved by other shares of its size than those that strangers are taken at."""
    gray = picture(name, 2 * HALF)
    shares = []
    for across, down in ((0.25, 0.4), (0.4, 0.75), (0.6, 0.2), (0.75, 0.6)):
        moved = np.roll(seen_again(gray), (round(256 * down), round(256 * across)), (0, 1))
        shares.append(alike(gray, moved, everywhere(gray), edges(gray)).mean())
    assert np.mean(shares) < 2 * STRANGERS


def test_an_image_moved_by_more_than_a_descriptor_does_not_agree(photo: np.ndarray) -> None:
    gray = luma(photo)
    moved = np.roll(gray, (25, 20), (0, 1))
    pixels = edges(gray)
    assert alike(gray, moved, everywhere(gray), pixels).mean() < 0.1
    nearly = np.roll(gray, 1, 1)
    assert alike(gray, nearly, everywhere(gray), pixels).mean() > 0.95


def test_what_is_not_seen_does_not_agree(photo: np.ndarray) -> None:
    gray = luma(photo)
    pixels = every_pixel(gray)
    seen = everywhere(gray)
    seen[:, 150:] = False
    agreed = alike(gray, gray, seen, pixels).reshape(gray.shape)
    assert not agreed[:, 150:].any()
    assert agreed[:, :150].mean() > 0.98
    assert not alike(gray, gray, np.zeros(gray.shape, bool), pixels).any()


def test_unlikeness_is_one_at_the_bound_and_infinite_where_nothing_is_seen(
    photo: np.ndarray,
) -> None:
    gray = luma(photo)
    pixels, seen = edges(gray), everywhere(gray)
    seen[:, 150:] = False
    found = unlikeness(gray, seen_again(gray), seen, pixels)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(np.isinf(found), pixels[:, 0] >= 150)
    np.testing.assert_array_equal(found < 1, alike(gray, seen_again(gray), seen, pixels))
    assert np.median(found[pixels[:, 0] < 150]) < np.median(
        unlikeness(gray, np.roll(gray, 25, 1), seen, pixels)[pixels[:, 0] < 150]
    )


def test_follows_the_order_of_the_points(photo: np.ndarray) -> None:
    gray = luma(photo)
    pixels = edges(gray)
    order = np.random.default_rng(0).permutation(len(pixels))
    second = seen_again(gray)
    second[:HALF, :HALF] = gray[HALF:, HALF:]
    agreed = alike(gray, second, everywhere(gray), pixels)
    assert 0.1 < agreed.mean() < 0.95
    np.testing.assert_array_equal(
        alike(gray, second, everywhere(gray), pixels[order]), agreed[order]
    )


def test_takes_keypoints_in_single_precision(photo: np.ndarray) -> None:
    gray = luma(photo)
    pixels = edges(gray)
    first, second = (
        alike(gray, seen_again(gray), everywhere(gray), pixels.astype(kind))
        for kind in (np.int64, np.float32)
    )
    np.testing.assert_array_equal(first, second)


def test_the_seed_decides_and_hardly_matters(photo: np.ndarray) -> None:
    """More blocks than are taken: the choice of strangers differs."""
    gray = cv2.resize(luma(photo), (1472, 1280))
    pixels = every_pixel(gray)[::31]
    assert len(np.unique(pixels // BLOCK, axis=0)) > BLOCKS
    found = [alike(gray, seen_again(gray), everywhere(gray), pixels, seed) for seed in (0, 0, 5)]
    np.testing.assert_array_equal(found[0], found[1])
    assert (found[0] == found[2]).mean() > 0.95


def test_up_to_a_megapixel_the_seed_has_no_say(photo: np.ndarray) -> None:
    gray = cv2.resize(luma(photo), (1000, 700))  # the largest of Oxford
    pixels = every_pixel(gray)[::31]
    assert 64 < len(np.unique(pixels // BLOCK, axis=0)) <= BLOCKS
    found = [unlikeness(gray, seen_again(gray), everywhere(gray), pixels, seed) for seed in (0, 5)]
    np.testing.assert_array_equal(found[0], found[1])


def test_what_is_known_of_the_unmoved_image_is_not_described_again_and_the_same(
    photo: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    gray = cv2.resize(luma(photo), (300, 240))
    pixels, second = edges(gray), seen_again(np.roll(gray, 40, 1))
    second[:, :200] = seen_again(gray)[:, :200]
    found = {}
    for edge in (strangers.EDGE, 10_000, 0):  # beyond the image: all moved images are described
        monkeypatch.setattr(strangers, "EDGE", edge)
        found[edge] = unlikeness(gray, second, everywhere(gray), pixels)
    real, plain, none = found.values()
    assert 0.3 < (plain < 1).mean() < 0.95
    np.testing.assert_array_equal(np.isinf(real), np.isinf(plain))
    some = np.isfinite(plain)
    np.testing.assert_allclose(real[some], plain[some], rtol=1e-4)
    assert not np.allclose(none[some], plain[some], rtol=1e-3)  # at edges it is not the same


def test_no_points_give_no_answers(photo: np.ndarray) -> None:
    gray = luma(photo)
    for nothing in (np.empty((0, 2)), np.empty((0, 2), np.int64)):
        found = alike(gray, gray, everywhere(gray), nothing)
        assert found.shape == (0,)
        assert found.dtype == bool


def test_one_point_is_taken(photo: np.ndarray) -> None:
    gray = luma(photo)
    found = alike(gray, gray, everywhere(gray), np.array([[80, 60]]))
    assert found.tolist() == [True]


def test_flat_images_tell_nothing(photo: np.ndarray) -> None:
    """No place is more like another than like any stranger."""
    flat = np.full((70, 90), 90, np.uint8)
    pixels = every_pixel(flat)
    assert not alike(flat, flat, everywhere(flat), pixels).any()
    for pair in ((luma(photo)[:70, :90], flat), (flat, luma(photo)[:70, :90])):
        assert alike(*pair, everywhere(flat), pixels).mean() < 1.5 * STRANGERS


@pytest.mark.parametrize("width", range(120, 280, 20))
def test_images_that_are_flat_for_a_large_part_tell_nothing(width: int) -> None:
    """A hundredth of the strangers are equal, flat ones: nothing can be more alike than they."""
    gray = np.full((300, 400), 235, np.uint8)
    noise = np.random.default_rng(width).normal(size=(300, width))
    gray[:, :width] = np.clip(128 + 150 * cv2.GaussianBlur(noise, (0, 0), 1.5), 0, 255)
    assert np.isinf(unlikeness(gray, gray, everywhere(gray), every_pixel(gray))).all()


@pytest.mark.parametrize("shape", [(1, 1), (5, 5), (1, 30), (16, 16)])
def test_tiny_images_are_taken(shape: tuple[int, int]) -> None:
    gray = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
    found = alike(gray, gray, everywhere(gray), every_pixel(gray))
    assert found.shape == (gray.size,)
    assert found.dtype == bool


@pytest.mark.parametrize("odd", [0, 1])
def test_points_far_apart_are_all_described(photo: np.ndarray, odd: int) -> None:
    """Every second point stands for its neighbours; a point without any stands for itself."""
    gray = luma(photo)
    pixels = every_pixel(gray)
    pixels = pixels[(pixels % 12 == (6, 6 + odd)).all(axis=1)]
    assert (pixels.sum(axis=1) % 2 == odd).all()
    second = np.roll(gray, 57, axis=1)  # the left half is right, the other is not
    second[:, : gray.shape[1] // 2] = gray[:, : gray.shape[1] // 2]
    scores = unlikeness(gray, second, everywhere(gray), pixels)
    right = pixels[:, 0] < gray.shape[1] // 2 - 50
    wrong = pixels[:, 0] > gray.shape[1] // 2 + 50
    assert np.isfinite(scores[right]).mean() > 0.9
    assert (scores[right] < 1).mean() > 0.9
    assert (scores[wrong] < 1).mean() < 0.05


def test_it_changes_little_which_points_are_described(photo: np.ndarray) -> None:
    """Points on pixels of one colour of a chessboard agree like those of the other."""
    gray = luma(photo)
    pixels = every_pixel(gray)
    even, odd = (pixels[pixels.sum(axis=1) % 2 == parity] for parity in (0, 1))
    second = seen_again(gray)
    shares = [alike(gray, second, everywhere(gray), part).mean() for part in (even, odd)]
    assert abs(shares[0] - shares[1]) < 0.03
