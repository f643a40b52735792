from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect.detector.points.hessian_scales import (
    OCTAVES,
    SIGMAS_PX,
    build_scale_space,
    find_candidates,
)

SECOND, MIXED = np.array([[1.0, -2, 1]]), [[1.0, 0, -1], [0, 0, 0], [-1, 0, 1]]


def blob(sigma: float, center=(40.3, 32.6), shape=(64, 80)) -> np.ndarray:
    y, x = np.indices(shape)
    squared = (x - center[0]) ** 2 + (y - center[1]) ** 2
    return np.rint(255 * np.exp(-squared / (2 * sigma**2))).astype(np.uint8)


def test_the_levels_are_gaussians_of_the_image() -> None:
    gray = np.random.default_rng(0).integers(0, 256, (90, 120), np.uint8)
    space = build_scale_space(gray)
    assert (OCTAVES == [0, 0, 0, 0, 0, 0, 1, 1, 2, 2]).all()
    for k, sigma in enumerate(SIGMAS_PX):
        wanted = cv2.GaussianBlur(gray.astype(np.float64) / 255, (0, 0), float(sigma))
        step = 1 << OCTAVES[k]
        # Smoothing twice cuts the tails off twice.
        found, edge = space.level(space.smooth, k) + space.gray, 30 // step
        inner = np.s_[edge:-edge, edge:-edge]
        np.testing.assert_allclose(found[inner], wanted[::step, ::step][inner], atol=0.01)


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
    strengths = np.empty(len(candidates), np.float32)
    for k in range(1, len(SIGMAS_PX) - 2):
        response = space.level(space.response, k)
        peak = response == cv2.dilate(response, np.ones([3 if OCTAVES[k] else 5] * 2, np.uint8))
        own = candidates.level == k
        pixel = candidates.row[own], candidates.column[own]
        expected = np.argwhere(peak[1:-1, 1:-1]) + 1
        assert {*zip(*pixel, strict=True)} == {*map(tuple, expected)}
        row, column = pixel
        down, across = (np.gradient(response.astype(np.float64), axis=axis) for axis in (0, 1))
        bends = [
            cv2.filter2D(response.astype(np.float64), -1, each)[pixel]
            for each in (SECOND, np.array(MIXED) / 4, SECOND.T)
        ]
        hessian = np.array([[bends[0], bends[1]], [bends[1], bends[2]]]).transpose(2, 0, 1)
        regular = (np.linalg.det(hessian) > 1e-20) & (bends[0] < 0)
        gradient = np.stack([across[pixel], down[pixel]], 1)[regular]
        offset = np.linalg.solve(hessian[regular], -gradient[..., None])[..., 0].clip(-0.499, 0.499)
        wanted = (np.stack([column, row], 1)[regular] + offset) * 2.0 ** OCTAVES[k]
        np.testing.assert_allclose(candidates.xy[own][regular], wanted, atol=1e-3)
        assert regular.mean() > 0.9
        strengths[own] = response[pixel]
    assert (np.diff(strengths) <= 0).all()
    np.testing.assert_array_equal(candidates.rank, np.arange(len(candidates)))
    few = find_candidates(space, 50)
    np.testing.assert_array_equal(few.xy, candidates.xy[:50])
    ignore = np.zeros(gray.shape, bool)
    ignore[:, :40] = True
    seen = candidates.pixels[1] >= 40
    np.testing.assert_array_equal(find_candidates(space, ignore=ignore).xy, candidates.xy[seen])


def test_flat_and_tiny_images_have_no_candidates() -> None:
    for shape in ((40, 50), (1, 1), (2, 30), (3, 3)):
        assert len(find_candidates(build_scale_space(np.full(shape, 90, np.uint8)))) == 0
