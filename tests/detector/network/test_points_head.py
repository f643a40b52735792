from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import ndimage

from deepdetect.detector.network import points_head
from deepdetect.detector.network.points_head import (
    HESSIAN_SIGMAS_PX,
    RESPONSES,
    PointsHead,
    classical_responses,
)
from deepdetect.evaluation.baselines.hessian import hessian_response


@pytest.fixture(scope="module")
def gray() -> np.ndarray:
    noise = np.random.default_rng(0).uniform(size=(50, 70))
    smooth = ndimage.gaussian_filter(noise, 1.2)
    return ((smooth - smooth.min()) / np.ptp(smooth)).astype(np.float32)


def as_batch(gray: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(gray)[None, None]


def test_it_has_ten_to_thirty_thousand_parameters() -> None:
    assert 10_000 <= sum(p.numel() for p in PointsHead().parameters()) <= 30_000


@pytest.mark.parametrize("sigma", HESSIAN_SIGMAS_PX)
def test_an_untrained_head_ranks_as_the_hessian_does(gray: np.ndarray, sigma: float) -> None:
    with torch.no_grad():
        logits = PointsHead(initial_sigma_px=sigma)(as_batch(gray))[0, 0].numpy()
    expected = np.log(hessian_response(gray, sigma) + 1e-7)
    inner = (slice(13, -13), slice(13, -13))
    assert np.corrcoef(logits[inner].ravel(), expected[inner].ravel())[0, 1] > 0.97


def test_matrices_and_convolutions_smooth_alike(gray: np.ndarray, monkeypatch) -> None:
    dense = classical_responses(as_batch(gray))
    monkeypatch.setattr(points_head, "MAX_DENSE_SIDE", 0)
    plain = classical_responses(as_batch(gray))
    assert dense.shape[1] == RESPONSES
    # Logarithms near 0, where det H changes its sign, are those of rounding errors.
    assert float((dense - plain).abs().quantile(0.99)) < 1e-2
    torch.testing.assert_close(dense[:, -2:], plain[:, -2:], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(("height", "width"), [(16, 16), (17, 30), (45, 71)])
def test_any_size(height: int, width: int) -> None:
    assert PointsHead()(torch.rand(2, 1, height, width)).shape == (2, 1, height, width)
