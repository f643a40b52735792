from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect.detector.points.hessian_scales import SIGMAS_PX, build_scale_space, find_candidates
from deepdetect.features.selection import peak_offset


def blob(sigma: float, center=(40.3, 32.6), shape=(64, 80)) -> np.ndarray:
    y, x = np.indices(shape)
    squared = (x - center[0]) ** 2 + (y - center[1]) ** 2
    return np.rint(255 * np.exp(-squared / (2 * sigma**2))).astype(np.uint8)


def test_the_levels_are_gaussians_of_the_image() -> None:
    gray = np.random.default_rng(0).integers(0, 256, (90, 120), np.uint8)
    space = build_scale_space(gray)
    for sigma, smooth in zip(SIGMAS_PX, space.smooth, strict=True):
        wanted = cv2.GaussianBlur(gray.astype(np.float64) / 255, (0, 0), float(sigma))
        # Smoothing twice cuts the tails off twice.
        found = smooth + space.gray
        np.testing.assert_allclose(found[30:-30, 30:-30], wanted[30:-30, 30:-30], atol=0.01)


def test_the_strongest_candidate_of_a_blob_is_its_centre_at_its_scale() -> None:
    gray = blob(4.0)
    space = build_scale_space(gray)
    candidates = find_candidates(space)
    best = int(np.argmin(candidates.rank))
    np.testing.assert_allclose(candidates.xy[best], (40.3, 32.6), atol=0.05)
    # The response of a Gaussian of 4 px is largest where both have the same sigma.
    assert candidates.sigma_px[best] == pytest.approx(4.0, rel=0.2)


def test_candidates_are_the_maxima_of_their_windows() -> None:
    gray = np.random.default_rng(2).integers(0, 256, (60, 80), np.uint8)
    space = build_scale_space(gray)
    candidates = find_candidates(space)
    response = np.abs(space.determinant)
    highest = np.stack([cv2.dilate(each, np.ones((5, 5), np.uint8)) for each in response])
    peak = (response == highest)[1:-2, 1:-1, 1:-1]
    pixels = np.stack([candidates.level, candidates.row, candidates.column], 1)
    np.testing.assert_array_equal(pixels, np.argwhere(peak) + 1)
    for axis, xy in ((1, candidates.xy[:, 0]), (0, candidates.xy[:, 1])):
        pixel = (candidates.row, candidates.column)
        wanted = np.choose(
            candidates.level - 1, [peak_offset(each, *pixel, axis) for each in response[1:-2]]
        )
        np.testing.assert_array_equal(xy - pixel[axis], pixel[axis] + wanted - pixel[axis])
    order = np.argsort(-response[tuple(pixels.T)], kind="stable")
    np.testing.assert_array_equal(candidates.rank[order], np.arange(len(candidates)))


def test_flat_and_tiny_images_have_no_candidates() -> None:
    for shape in ((40, 50), (1, 1), (2, 30), (3, 3)):
        assert len(find_candidates(build_scale_space(np.full(shape, 90, np.uint8)))) == 0
