"""Patches of a synthetic view, whose true positions and affinities are known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import skimage.data

from deepdetect.geometry.alignment import Alignment, align_patches

AFFINITY = np.array([[1.05, 0.06], [-0.04, 0.97]])
SHIFT = np.array([3.3, 4.6])


def images() -> tuple[np.ndarray, np.ndarray]:
    first = cv2.GaussianBlur(skimage.data.camera()[50:250, 150:400].astype(np.float32), (0, 0), 1.5)
    matrix, size = np.column_stack([AFFINITY, SHIFT]), first.shape[::-1]
    second = cv2.warpAffine(first, matrix, size, flags=cv2.INTER_LANCZOS4)
    return first, 1.3 * second - 10


@pytest.mark.parametrize("cubic", [False, True])
def test_positions_and_affinities_are_found(cubic: bool) -> None:
    first, second = images()
    points0 = np.random.default_rng(0).uniform((25, 25), (215, 165), (60, 2))
    true = points0 @ AFFINITY.T + SHIFT
    how = Alignment(8, 2.0, 0.01, affine=True, cubic=cubic)
    start = true + np.random.default_rng(1).uniform(-0.7, 0.7, true.shape)
    found = align_patches((first, second), points0, start, np.tile(np.eye(2), (60, 1, 1)), how)
    assert found.converged.sum() >= 40
    off = np.linalg.norm(found.points1 - true, axis=1)[found.converged]
    assert np.median(off) < 0.03
    gaps = (found.affinities - AFFINITY)[found.converged]
    assert np.median(np.abs(gaps).max(axis=(1, 2))) < 0.02
    assert (found.points1[~found.converged] == start[~found.converged]).all()


def test_the_covariance_tells_along_which_axis_a_position_is_known() -> None:
    """Vertical stripes that are hardly modulated tell x much better than y."""
    y, x = np.indices((80, 90), np.float32)
    image = 100 + 50 * np.sin(x) + 3 * np.sin(y / 2)
    noise = np.random.default_rng(0).normal(0, 2, (2, *image.shape)).astype(np.float32)
    images = image + noise[0], image + noise[1]
    points = np.float64([[40, 30], [45, 41], [33, 52]])
    how = Alignment(8, 2.0, 0.01)
    found = align_patches(images, points, points, np.tile(np.eye(2), (3, 1, 1)), how)
    assert found.converged.all()
    assert (found.covariances[:, 1, 1] > 20 * found.covariances[:, 0, 0]).all()
