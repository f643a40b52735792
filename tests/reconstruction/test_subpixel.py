from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from deepdetect import Matches
from deepdetect.io.image import luma
from deepdetect.reconstruction.subpixel import (
    local_affinities,
    refine_dense,
    similarity,
    spread_corners,
)


@pytest.fixture(scope="module")
def gray(photo: np.ndarray) -> np.ndarray:
    """The photograph, a little smooth so that it can be moved by parts of a pixel, not square."""
    return cv2.GaussianBlur(luma(photo)[:220], (0, 0), 1)


@pytest.fixture(scope="module")
def pixels() -> np.ndarray:
    grid = np.stack(np.meshgrid(np.arange(20, 236, 4), np.arange(20, 200, 4)), -1)
    return grid.reshape(-1, 2)


def moved(gray: np.ndarray, across: float, down: float) -> np.ndarray:
    """Move an image by Fourier's theorem: exact, and no kernel of interpolation that we use."""
    v, u = np.meshgrid(*(np.fft.fftfreq(side) for side in gray.shape), indexing="ij")
    turned = np.fft.fft2(gray.astype(float)) * np.exp(-2j * np.pi * (u * across + v * down))
    return np.clip(np.rint(np.fft.ifft2(turned).real), 0, 255).astype(np.uint8)


def errors(found: tuple[np.ndarray, np.ndarray], expected: np.ndarray) -> np.ndarray:
    """Return how far those that have converged are from where they should be."""
    points, converged = found
    return np.linalg.norm(points - expected, axis=1)[converged]


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.5, 0.5), (-0.9, 0.4)])
def test_known_shifts_are_found(
    gray: np.ndarray, pixels: np.ndarray, shift: tuple[float, float]
) -> None:
    found = refine_dense(gray, moved(gray, *shift), pixels, pixels)
    assert found[1].mean() > 0.7
    assert np.median(errors(found, pixels + shift)) < 0.04
    assert (errors(found, pixels + shift) < 0.25).mean() > 0.9
    # No pull towards whole pixels.
    bias = np.median((found[0] - pixels - shift)[found[1]], axis=0)
    assert np.abs(bias).max() < 0.02


def test_the_light_does_not_matter(gray: np.ndarray, pixels: np.ndarray) -> None:
    other = moved(gray, 0.4, -0.3)
    dim = np.clip(other * 0.6 + 30, 0, 255).astype(np.uint8)
    plain, lit = (refine_dense(gray, image, pixels, pixels) for image in (other, dim))
    both = plain[1] & lit[1]
    assert both.mean() > 0.65
    assert np.median(np.linalg.norm(plain[0] - lit[0], axis=1)[both]) < 0.03
    assert not refine_dense(gray, 255 - gray, pixels, pixels)[1].any()


def test_a_turn_is_followed(gray: np.ndarray, pixels: np.ndarray) -> None:
    turn = cv2.getRotationMatrix2D((128, 110), 12, 1.1)
    other = cv2.warpAffine(gray, turn, gray.shape[::-1], flags=cv2.INTER_CUBIC)
    true = pixels @ turn[:, :2].T + turn[:, 2]
    found = refine_dense(gray, other, pixels, np.rint(true))
    inside = ((true > 8) & (true < np.array(gray.shape[::-1]) - 9)).all(1)
    assert found[1][inside].mean() > 0.8
    assert not found[1][((true < 0) | (true > gray.shape[::-1])).any(1)].any()
    assert np.median(errors(found, true)) < 0.04
    np.testing.assert_allclose(similarity(pixels, true), turn[:, :2], atol=1e-6)


@pytest.mark.slow
def test_real_matches_come_nearer_to_the_truth(turned: Any, turned_matches: Matches) -> None:
    points0, points1 = turned_matches.points0, np.rint(turned_matches.points1)
    true = turned.match(points0)
    refined, converged = refine_dense(*turned.grays, points0, points1)
    assert converged.mean() > 0.7
    known = np.isfinite(true).all(1) & converged
    before, after = (np.linalg.norm(points - true, axis=1)[known] for points in (points1, refined))
    assert (after < 0.25).mean() > 2 * (before < 0.25).mean()
    assert np.median(after) < 0.6 * np.median(before)


def test_what_cannot_be_aligned_stays_and_says_so(gray: np.ndarray) -> None:
    pixels = np.array([[100, 100], [0, 0], [255, 219], [100, 100]])
    start = np.array([[100.25, 100.0], [0, 0], [255, 219], [140, 30]])
    points, converged = refine_dense(gray, gray, pixels, start)
    assert converged.tolist() == [True, False, False, False]
    np.testing.assert_array_equal(points[1:], start[1:])
    assert points[0] == pytest.approx((100, 100), abs=0.01)
    flat = np.full_like(gray, 90)
    stripes = np.broadcast_to(np.uint8(100 + 80 * np.sin(np.arange(256) / 3)), (220, 256)).copy()
    for images in ((flat, gray), (gray, flat), (flat, flat), (stripes, stripes)):
        assert not refine_dense(*images, pixels, start)[1].any()


def test_corners_come_from_all_parts_of_the_image_each_once(
    gray: np.ndarray, pixels: np.ndarray
) -> None:
    rows = spread_corners(gray, pixels, 60)
    assert (np.diff(rows) > 0).all()
    assert 40 <= len(rows) <= 80
    quarter = (pixels[rows] > np.median(pixels, axis=0)) @ [1, 2]
    assert np.bincount(quarter, minlength=4).min() > 5
    strength = cv2.cornerMinEigenVal(gray, 7)[pixels[:, 1], pixels[:, 0]]
    assert np.median(strength[rows]) > 2 * np.median(strength)
    assert len(spread_corners(gray, pixels, 10**9)) == len(pixels)
    assert len(spread_corners(gray, np.empty((0, 2)), 60)) == 0


def test_affinities_are_those_of_the_motion_around() -> None:
    pixels = np.stack(np.meshgrid(np.arange(60), np.arange(50)), -1).reshape(-1, 2)
    one, other = np.array([[1.1, 0.1], [0, 0.9]]), np.array([[0.9, -0.1], [0.2, 1.2]])
    left = pixels[:, 0] < 30
    places = np.where(left[:, None], pixels @ one.T, pixels @ other.T + 500)
    found = local_affinities(pixels, places, np.ones(3000, bool), (50, 60), np.eye(2))
    inner = ((pixels > 7) & (pixels < [52, 42])).all(1)
    # A tenth falls back on the affinity of all: 225 neighbours against 20.
    for side, true in ((pixels[:, 0] < 22, one), (pixels[:, 0] > 37, other)):
        expected = np.eye(2) + (true - np.eye(2)) * 225 / 245
        np.testing.assert_allclose(
            found[inner & side], np.broadcast_to(expected, found[inner & side].shape), atol=1e-3
        )
    alone = local_affinities(
        np.array([[5, 5]]), np.array([[9.0, 9.0]]), np.ones(1, bool), (50, 60), one
    )
    np.testing.assert_allclose(alone[0], one, atol=1e-6)
