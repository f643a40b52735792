from __future__ import annotations

import cv2
import numpy as np

from deepdetect.detector.points.candidate_features import FEATURES, describe_candidates
from deepdetect.detector.points.hessian_scales import (
    OCTAVES,
    build_scale_space,
    find_candidates,
)


def textured(seed: int = 0, side: int = 161) -> np.ndarray:
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


def test_a_quarter_turn_changes_nothing() -> None:
    gray = textured()
    here, first = features(gray)
    there, second = features(np.ascontiguousarray(np.rot90(gray)))
    # (x, y) is seen at (y, W - 1 - x) of the turned image; all levels have its outermost pixels.
    place = {
        (int(k), int(r), int(c)): n
        for n, (k, r, c) in enumerate(zip(there.level, there.row, there.column, strict=True))
    }
    sides = -(-len(gray) // (1 << OCTAVES))
    found = [
        (n, place[key])
        for n, (k, r, c) in enumerate(zip(here.level, here.row, here.column, strict=True))
        if (key := (int(k), int(sides[k] - 1 - c), int(r))) in place
    ]
    assert len(found) > 0.95 * len(here)
    a, b = np.array(found).T
    # Rounding and ties move some points of the rings by a pixel.
    close = np.abs(first[a] - second[b]) < 0.02
    assert close.mean() > 0.97
