"""The compiled parts of the points, beside OpenCV's filters and maps of NumPy."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy import ndimage

pytest.importorskip("numba", reason="needs numba")

from deepdetect.detector.points.candidate_features import describe_candidates
from deepdetect.detector.points.hessian_scales import (
    OCTAVES,
    SIGMAS_PX,
    build_scale_space,
    find_candidates,
)
from deepdetect.detector.points.kernels import differentiate


def test_the_hessian_of_small_images_is_that_of_a_mirrored_border() -> None:
    for shape in ((1, 5), (2, 2), (9, 13)):
        smooth = np.random.default_rng(0).normal(size=shape).astype(np.float32)
        found = np.zeros(shape, np.float32)
        differentiate(smooth, np.float32(3), found)
        xx, yy = (ndimage.correlate1d(smooth, [1, -2, 1], axis, mode="mirror") for axis in (1, 0))
        xy = smooth
        for axis in (0, 1):
            xy = ndimage.correlate1d(xy, [-0.5, 0, 0.5], axis, mode="mirror")
        np.testing.assert_allclose(found, abs(9 * (xx * yy - xy**2)), rtol=1e-4, atol=1e-4)


def test_derivatives_are_those_of_opencv() -> None:
    gray = np.random.default_rng(1).integers(0, 256, (50, 70), np.uint8)
    space = build_scale_space(gray)
    for k, sigma in enumerate(SIGMAS_PX / 2.0**OCTAVES):
        smooth = space.level(space.smooth, k)
        xx, yy = (
            cv2.filter2D(smooth, -1, kernel)
            for kernel in (np.array([[1.0, -2, 1]]), np.array([[1.0], [-2], [1]]))
        )
        xy = cv2.filter2D(
            cv2.filter2D(smooth, -1, np.array([[-0.5, 0, 0.5]])), -1, np.array([[-0.5], [0], [0.5]])
        )
        wanted = np.abs(xx * yy - xy**2) * sigma**4
        np.testing.assert_allclose(space.level(space.response, k), wanted, atol=1e-5)


def test_measurements_are_those_of_maps() -> None:
    noise = np.random.default_rng(1).normal(size=(96, 96))
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.5) + 2 * cv2.GaussianBlur(noise.T, (0, 0), 4)
    gray = np.uint8(255 * (smooth - smooth.min()) / np.ptp(smooth))
    space = build_scale_space(gray)
    candidates = find_candidates(space)
    found = describe_candidates(space, candidates)
    smooth = [space.level(space.smooth, k).astype(np.float64) for k in range(len(SIGMAS_PX))]
    response = [space.level(space.response, k) for k in range(len(SIGMAS_PX))]
    first, second = np.array([[-0.5, 0, 0.5]]), np.array([[1.0, -2, 1]])
    for n in range(0, len(candidates), 7):
        level, row, column = (
            int(a[n]) for a in (candidates.level, candidates.row, candidates.column)
        )
        near = range(level - 1, level + 3)
        places = {
            k: tuple(
                min(int(np.floor(each * 2.0 ** (OCTAVES[level] - OCTAVES[k]) + 0.5)), side - 1)
                for each, side in zip((row, column), smooth[k].shape, strict=True)
            )
            for k in near
        }
        assert places[level] == (row, column)
        own = np.log(response[level][row, column] + 1e-7)
        strength = np.sqrt(response[level][row, column] + 1e-8)
        values = [(own + 9) / 3]
        beside = [level - 1, level + 1, level + 2]
        values += [(np.log(response[k][places[k]] + 1e-7) - own) / 2 for k in beside]
        xx, yy = (cv2.filter2D(smooth[level], -1, each) for each in (second, second.T))
        xy = cv2.filter2D(cv2.filter2D(smooth[level], -1, first), -1, first.T)
        values += [np.sign(xx * yy - xy**2)[row, column]]
        slopes = []
        for k in near:
            variance = (SIGMAS_PX[k] / 2 ** OCTAVES[k]) ** 2
            laplacian = cv2.filter2D(smooth[k], -1, second) + cv2.filter2D(smooth[k], -1, second.T)
            bent = np.arctan(laplacian[places[k]] * variance / strength / 2)
            values += [bent, abs(bent)]
            dx, dy = cv2.filter2D(smooth[k], -1, first), cv2.filter2D(smooth[k], -1, first.T)
            slopes.append(np.log((dx**2 + dy**2) * variance + 1e-6) / 2)
        values += [(each[places[k]] - own / 2) / 2 for k, each in zip(near, slopes, strict=True)]
        values += [2 * (smooth[level][row, column] + space.gray) - 1]
        for k in beside:
            y, x = places[k]
            window = response[k][max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3]
            values += [np.log((window.max() + 1e-7) / (response[k][y, x] + 1e-7)) / 2]
        angle, last = np.arange(8) * np.pi / 4, np.array(smooth[level].shape) - 1
        for radius in (1, 2, 3.5, 6):
            reach = radius * SIGMAS_PX[level] / 2 ** OCTAVES[level]
            x = np.clip(np.rint(column + reach * np.cos(angle)), 0, last[1]).astype(int)
            y = np.clip(np.rint(row + reach * np.sin(angle)), 0, last[0]).astype(int)
            ring = np.log(response[level][y, x] + 1e-7) - own
            values += [ring.mean() / 2, ring.max() / 2, ring.min() / 4]
            light = (smooth[level][y, x] - smooth[level][row, column]) / strength
            values += [np.arctan(each / 2) for each in (light.mean(), light.max(), light.min())]
            ring = slopes[1][y, x] - own / 2
            values += [ring.mean() / 2, ring.max() / 2]
        values += [np.log((candidates.rank[n] + 1) / gray.size) / 2 + 3, (level - 4) / 3]
        np.testing.assert_allclose(found[n], values, atol=2e-3)
