from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest

from deepdetect.features.sift import dense_sift
from deepdetect.io.image import load_image, luma
from deepdetect.matching.guided import verification
from deepdetect.matching.guided.verification import (
    DESCRIPTOR_REACH,
    FALSE_POSITIVE_RATE,
    KEYPOINT_SIZES_PX,
    NULL_SHIFTS,
    dissimilarity,
    sample_null_pairs,
)

BLOCK, BLOCKS = verification.NULL_BLOCK_PX, verification.MAX_NULL_BLOCKS

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


def same_patches(*arguments: Any, **named: Any) -> np.ndarray:
    return dissimilarity(*arguments, **named) < 1


def every_pixel(gray: np.ndarray) -> np.ndarray:
    row, column = np.indices(gray.shape)
    return np.column_stack([column.ravel(), row.ravel()])


def edges(gray: np.ndarray) -> np.ndarray:
    """Pixels of contours: what dense keypoints lie on."""
    row, column = np.nonzero(cv2.Canny(gray, 60, 120))
    return np.column_stack([column, row])


def seen_again(gray: np.ndarray) -> np.ndarray:
    """The function returns the same scene in other light, with noise."""
    noise = np.random.default_rng(0).normal(0, 4, gray.shape)
    return np.clip(gray * 0.8 + 20 + noise, 0, 255).astype(np.uint8)


def everywhere(gray: np.ndarray) -> np.ndarray:
    return np.ones(gray.shape, bool)


def test_the_same_image_agrees_nearly_everywhere(photo: np.ndarray) -> None:
    gray = luma(photo)
    pixels = every_pixel(gray)
    assert same_patches(gray, gray, everywhere(gray), pixels).mean() > 0.99
    assert same_patches(gray, seen_again(gray), everywhere(gray), pixels).mean() > 0.95


@pytest.mark.parametrize(
    ("name", "other"),
    [("camera", "rocket"), pytest.param("astronaut", "coffee", marks=pytest.mark.slow)],
)
def test_under_another_photograph_next_to_nothing_agrees(
    picture: Callable[..., np.ndarray], name: str, other: str
) -> None:
    """It is pasted over one quarter of the second image after the other."""
    gray, strange = picture(name, 2 * HALF), picture(other, HALF)
    pixels = edges(gray)
    under_it, others = [], []
    for top, left in ((0, 0), (0, HALF), (HALF, 0), (HALF, HALF)):
        second = seen_again(gray)
        second[top : top + HALF, left : left + HALF] = strange
        agreed = same_patches(gray, second, everywhere(gray), pixels)
        pasted = np.zeros(gray.shape, np.uint8)
        pasted[top : top + HALF, left : left + HALF] = 1
        kernel = np.ones((2 * REACH + 1, 2 * REACH + 1), np.uint8)
        inner, outer = cv2.erode(pasted, kernel), cv2.dilate(pasted, kernel)
        column, row = pixels.T
        under_it.append(agreed[inner[row, column] > 0])
        others.append(agreed[outer[row, column] == 0])
    assert np.concatenate(others).mean() > 0.95
    assert np.concatenate(under_it).mean() < FALSE_POSITIVE_RATE


@pytest.mark.parametrize("name", ["astronaut", pytest.param("coffee", marks=pytest.mark.slow)])
def test_few_null_pairs_pass(picture: Callable[..., np.ndarray], name: str) -> None:
    """The image is shifted by other shares of its size than the null pairs are."""
    gray = picture(name, 2 * HALF)
    shares = []
    for across, down in ((0.25, 0.4), (0.4, 0.75), (0.6, 0.2), (0.75, 0.6)):
        moved = np.roll(seen_again(gray), (round(256 * down), round(256 * across)), (0, 1))
        shares.append(same_patches(gray, moved, everywhere(gray), edges(gray)).mean())
    assert np.mean(shares) < 2 * FALSE_POSITIVE_RATE


def test_what_is_not_seen_does_not_agree(photo: np.ndarray) -> None:
    gray = luma(photo)
    pixels = every_pixel(gray)
    seen = everywhere(gray)
    seen[:, 150:] = False
    agreed = same_patches(gray, gray, seen, pixels).reshape(gray.shape)
    assert not agreed[:, 150:].any()
    assert agreed[:, :150].mean() > 0.98
    assert not same_patches(gray, gray, np.zeros(gray.shape, bool), pixels).any()


def test_follows_the_order_of_the_points(photo: np.ndarray) -> None:
    gray = luma(photo)
    pixels = edges(gray)
    order = np.random.default_rng(0).permutation(len(pixels))
    second = seen_again(gray)
    second[:HALF, :HALF] = gray[HALF:, HALF:]
    agreed = same_patches(gray, second, everywhere(gray), pixels)
    assert 0.1 < agreed.mean() < 0.95
    np.testing.assert_array_equal(
        same_patches(gray, second, everywhere(gray), pixels[order]), agreed[order]
    )


def test_images_that_are_flat_for_a_large_part_tell_nothing() -> None:
    """A hundredth of the null pairs are equal, flat ones: nothing can be more similar."""
    gray = np.full((300, 400), 235, np.uint8)
    noise = np.random.default_rng(0).normal(size=(300, 180))
    gray[:, :180] = np.clip(128 + 150 * cv2.GaussianBlur(noise, (0, 0), 1.5), 0, 255)
    assert np.isinf(dissimilarity(gray, gray, everywhere(gray), every_pixel(gray))).all()


@pytest.mark.parametrize("odd", [0, 1])
def test_points_far_apart_are_all_described(photo: np.ndarray, odd: int) -> None:
    """Every second point stands for its neighbours; a point without any stands for itself."""
    gray = luma(photo)
    pixels = every_pixel(gray)
    pixels = pixels[(pixels % 12 == (6, 6 + odd)).all(axis=1)]
    assert (pixels.sum(axis=1) % 2 == odd).all()
    second = np.roll(gray, 57, axis=1)  # the left half is right, the other is not
    second[:, : gray.shape[1] // 2] = gray[:, : gray.shape[1] // 2]
    scores = dissimilarity(gray, second, everywhere(gray), pixels)
    right = pixels[:, 0] < gray.shape[1] // 2 - 50
    wrong = pixels[:, 0] > gray.shape[1] // 2 + 50
    assert np.isfinite(scores[right]).mean() > 0.9
    assert (scores[right] < 1).mean() > 0.9
    assert (scores[wrong] < 1).mean() < 0.05


# Null pairs


@pytest.fixture
def gray(photo: np.ndarray) -> np.ndarray:
    return cv2.resize(luma(photo), (301, 240))


@pytest.fixture
def points(gray: np.ndarray) -> np.ndarray:
    return every_pixel(gray)[::7]


def at_edge(gray: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    size = np.array(gray.shape[::-1])
    return (np.minimum(pixels, size - 1 - pixels) < DESCRIPTOR_REACH).any(axis=1)


def test_under_a_point_of_the_shifted_image_lies_its_null_partner(
    gray: np.ndarray, points: np.ndarray
) -> None:
    chosen = sample_null_pairs(points, gray, everywhere(gray))
    assert len(chosen) == len(NULL_SHIFTS)
    for null in chosen:
        left_out = np.setdiff1d(np.arange(len(points)), null.rows)
        assert 0 < len(left_out) < 0.4 * len(points)  # their partners alone lie at an edge
        assert at_edge(gray, points[null.rows])[~null.interior].all()
        assert not at_edge(gray, points[left_out]).any()
        assert not at_edge(gray, null.partners[null.interior]).any()
        here = points[null.rows]
        np.testing.assert_array_equal(
            null.shifted[here[:, 1], here[:, 0]],
            gray[null.partners[:, 1], null.partners[:, 0]],
        )
        apart = np.abs(here - null.partners).max(axis=1)
        assert apart.min() >= min(gray.shape) // 3


@pytest.mark.parametrize("size", KEYPOINT_SIZES_PX)
def test_interior_descriptors_are_those_of_the_image_that_is_not_shifted(
    gray: np.ndarray, points: np.ndarray, size: float
) -> None:
    for null in sample_null_pairs(points, gray, everywhere(gray)):
        assert 0.1 < null.interior.mean() < 0.9
        moved = dense_sift(null.shifted, points[null.rows], size)
        unmoved = dense_sift(gray, null.partners, size)
        np.testing.assert_array_equal(moved[null.interior], unmoved[null.interior])
        assert (moved != unmoved).any(axis=1).mean() > 0.03  # those at an edge are others
