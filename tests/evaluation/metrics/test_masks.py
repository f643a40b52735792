from __future__ import annotations

import numpy as np
import pytest

from deepdetect import ImageError
from deepdetect.evaluation.metrics.masks import MaskScore, mean_score, score_heatmap


def test_known_answers() -> None:
    heatmap = np.array([[0.9, 0.8, 0.2, 0.4]])
    mask = np.array([[True, False, True, False]])
    score = score_heatmap(heatmap, mask)
    assert score.loss == pytest.approx(-np.log([0.9, 0.2, 0.2, 0.6]).mean())
    assert score.iou == pytest.approx(1 / 3)


def test_empty_masks_agree() -> None:
    assert score_heatmap(np.zeros((4, 4)), np.zeros((4, 4), bool)).iou == 1


def test_certain_and_wrong_is_finite() -> None:
    assert score_heatmap(np.ones((4, 4)), np.zeros((4, 4), bool)).loss == pytest.approx(
        -np.log(1e-7)
    )


def test_the_loss_is_torch_s() -> None:
    torch = pytest.importorskip("torch", reason="needs torch, which is for training only")
    rng = np.random.default_rng(0)
    logits, mask = rng.normal(0, 3, (32, 32)).astype(np.float32), rng.random((32, 32)) < 0.3
    expected = torch.nn.functional.binary_cross_entropy_with_logits(
        torch.from_numpy(logits), torch.from_numpy(mask).float()
    )
    assert score_heatmap(1 / (1 + np.exp(-logits)), mask).loss == pytest.approx(
        float(expected), abs=1e-5
    )


def test_images_count_the_same() -> None:
    mean = mean_score([MaskScore(1, 0.2, 1), MaskScore(3, 0.4, 1)])
    assert (mean.loss, mean.iou, mean.images) == (2, pytest.approx(0.3), 2)
    with pytest.raises(ImageError):
        mean_score([])
