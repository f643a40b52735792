from __future__ import annotations

import io

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from deepdetect.training import variation
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


def test_all_of_it_comes_from_inside() -> None:
    """The places that a view is sampled from, seen in two ramps."""
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


def sharpness(view: np.ndarray) -> float:
    return float(cv2.Laplacian(cv2.cvtColor(view, cv2.COLOR_RGB2GRAY), cv2.CV_64F).std())


def test_some_views_are_blurred_and_some_relit(photo: np.ndarray) -> None:
    small = cv2.resize(photo, (200, 200), interpolation=cv2.INTER_AREA)
    views = [vary(small, 128, seed) for seed in range(60)]
    sharp = [sharpness(view) for view in views]
    assert max(sharp) > 8 * min(sharp)
    assert np.std([view.mean() for view in views]) > 10


def test_some_views_have_noise() -> None:
    flat = np.full((80, 80, 3), 128, np.uint8)
    noise = [vary(flat, 64, seed).std() for seed in range(60)]
    assert 5 < sum(deviation > 0.5 for deviation in noise) < 30
    assert 3 < max(noise) < 12


def test_relighting_is_one_rising_curve_for_all_channels() -> None:
    levels = np.arange(256, dtype=np.uint8)[None, :, None].repeat(3, 2)
    curves = [variation._relit(levels, np.random.default_rng(seed))[0] for seed in range(30)]
    for curve in curves:
        assert (curve == curve[:, :1]).all()
        assert (np.diff(curve[:, 0].astype(int)) >= 0).all()
    middles = [int(curve[128, 0]) for curve in curves]
    assert min(middles) < 110
    assert max(middles) > 145


def test_compression_is_that_of_pillow(photo: np.ndarray) -> None:
    """Channels in their order: with red and blue swapped the luma would lose more."""
    file = io.BytesIO()
    Image.fromarray(photo).save(file, "JPEG", quality=30)
    expected = np.asarray(Image.open(file)).astype(int)
    found = variation._compressed(photo, 30).astype(int)
    assert np.abs(found - expected).mean() < 2
    assert np.abs(found - photo).mean() > 2
