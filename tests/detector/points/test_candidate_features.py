from __future__ import annotations

import cv2
import numpy as np

from deepdetect.detector.points.candidate_features import FEATURES, describe_candidates
from deepdetect.detector.points.hessian_scales import SIGMAS_PX, build_scale_space, find_candidates


def textured(seed: int = 0, side: int = 160) -> np.ndarray:
    generator = np.random.default_rng(seed)
    layers = [
        cv2.GaussianBlur(generator.standard_normal((side, side)), (0, 0), sigma) * sigma
        for sigma in (1.5, 3, 6)
    ]
    total = np.sum(layers, axis=0)
    return np.uint8(255 * (total - total.min()) / np.ptp(total))


def features(gray: np.ndarray):
    space = build_scale_space(gray)
    candidates = find_candidates(space)
    return candidates, describe_candidates(space, candidates)


def test_shape_and_values() -> None:
    candidates, found = features(textured())
    assert found.shape == (len(candidates), FEATURES)
    assert found.dtype == np.float32
    assert np.isfinite(found).all()
    assert found.std(0).min() > 0  # each of them says something


def test_measurements_are_those_of_maps() -> None:
    gray = textured(1, 96)
    space = build_scale_space(gray)
    candidates = find_candidates(space)
    found = describe_candidates(space, candidates)
    response = np.abs(space.determinant)
    first, second = np.array([[-0.5, 0, 0.5]]), np.array([[1.0, -2, 1]])
    for n in range(0, len(candidates), 7):
        level, row, column = (
            int(a[n]) for a in (candidates.level, candidates.row, candidates.column)
        )
        own = np.log(response[level, row, column] + 1e-7)
        strength = np.sqrt(response[level, row, column] + 1e-8)
        values = [(own + 9) / 3]
        beside = [level - 1, level + 1, level + 2]
        values += [(np.log(response[k, row, column] + 1e-7) - own) / 2 for k in beside]
        values += [np.sign(space.determinant[level, row, column])]
        slopes = []
        for k in range(level - 1, level + 3):
            image, variance = space.smooth[k].astype(np.float64), SIGMAS_PX[k] ** 2
            laplacian = cv2.filter2D(image, -1, second) + cv2.filter2D(image, -1, second.T)
            bent = np.arctan(laplacian[row, column] * variance / strength / 2)
            values += [bent, abs(bent)]
            dx, dy = cv2.filter2D(image, -1, first), cv2.filter2D(image, -1, first.T)
            slopes.append(np.log((dx**2 + dy**2) * variance + 1e-6) / 2)
        values += [(each[row, column] - own / 2) / 2 for each in slopes]
        values += [2 * (space.smooth[level, row, column] + space.gray) - 1]
        for k in beside:
            window = response[k, max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3]
            values += [np.log((window.max() + 1e-7) / (response[k, row, column] + 1e-7)) / 2]
        angle = np.arange(8) * np.pi / 4
        for radius in (1, 2, 3.5, 6):
            reach = radius * SIGMAS_PX[level]
            x = np.clip(np.rint(column + reach * np.cos(angle)), 0, 95).astype(int)
            y = np.clip(np.rint(row + reach * np.sin(angle)), 0, 95).astype(int)
            ring = np.log(response[level, y, x] + 1e-7) - own
            values += [ring.mean() / 2, ring.max() / 2, ring.min() / 4]
            light = (space.smooth[level, y, x] - space.smooth[level, row, column]) / strength
            values += [np.arctan(each / 2) for each in (light.mean(), light.max(), light.min())]
            ring = slopes[1][y, x] - own / 2
            values += [ring.mean() / 2, ring.max() / 2]
        values += [np.log((candidates.rank[n] + 1) / gray.size) / 2 + 3, (level - 4) / 3]
        np.testing.assert_allclose(found[n], values, atol=2e-3)


def test_a_quarter_turn_changes_nothing() -> None:
    gray = textured()
    here, first = features(gray)
    there, second = features(np.ascontiguousarray(np.rot90(gray)))
    # (x, y) is seen at (y, W - 1 - x) of the turned image.
    place = {
        (int(k), int(r), int(c)): n
        for n, (k, r, c) in enumerate(zip(there.level, there.row, there.column, strict=True))
    }
    side = len(gray)
    found = [
        (n, place[key])
        for n, (k, r, c) in enumerate(zip(here.level, here.row, here.column, strict=True))
        if (key := (int(k), side - 1 - int(c), int(r))) in place
    ]
    assert len(found) > 0.95 * len(here)
    a, b = np.array(found).T
    # Rounding and ties move some points of the rings by a pixel.
    close = np.abs(first[a] - second[b]) < 0.02
    assert close.mean() > 0.97
