from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect.training.variation import vary


@given(
    height=st.integers(20, 200),
    width=st.integers(20, 200),
    side=st.integers(16, 160),
    seed=st.integers(0, 2**32 - 1),
)
def test_any_photograph_gives_a_square(height: int, width: int, side: int, seed: int) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    view = vary(rgb, side, seed)
    assert view.shape == (side, side, 3)
    assert view.dtype == np.uint8
    np.testing.assert_array_equal(view, vary(rgb, side, seed))


def test_seeds_give_other_views(photo: np.ndarray) -> None:
    views = {vary(photo, 64, seed).tobytes() for seed in range(20)}
    assert len(views) == 20


def test_all_of_it_comes_from_inside(photo: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    """The places that a view is sampled from, seen in two ramps; the rest is switched off."""
    from deepdetect.training import variation

    rows, columns = np.mgrid[0:200, 0:240].astype(np.uint8)
    ramps = np.dstack([columns, rows, np.zeros_like(rows)])
    edges = []
    for seed in range(200):
        view = variation._turned(ramps, 100, np.random.default_rng(seed)).astype(float)
        across = view[50, 75, :2] - view[50, 25, :2]
        down = view[75, 50, :2] - view[25, 50, :2]
        # Turned and scaled alike along both axes, and not mirrored.
        assert np.linalg.norm(across) == pytest.approx(np.linalg.norm(down), rel=0.06)
        assert across @ down == pytest.approx(0, abs=0.06 * (across @ across))
        assert across[0] * down[1] - across[1] * down[0] > 0
        # The corners go on where the centre points to: nothing is reflected at a border.
        centre = view[49:51, 49:51, :2].mean((0, 1))
        corner = centre + (across + down) * 49.5 / 50
        inside = np.clip(corner, 0, [239, 199])
        assert np.abs(corner - inside).max() < 2
        edges.append(np.linalg.norm(across) / 50)
    assert min(edges) < 1.1
    assert max(edges) > 1.6


def test_light_blur_noise_and_compression_all_occur(photo: np.ndarray) -> None:
    gray = cv2.resize(photo, (200, 200), interpolation=cv2.INTER_AREA)
    views = [cv2.cvtColor(vary(gray, 128, seed), cv2.COLOR_RGB2GRAY) for seed in range(60)]
    sharpness = [cv2.Laplacian(view, cv2.CV_64F).std() for view in views]
    assert max(sharpness) > 8 * min(sharpness)
    means = [view.mean() for view in views]
    assert np.std(means) > 10
