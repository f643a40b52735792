from __future__ import annotations

import numpy as np
import pytest

from deepdetect.evaluation.metrics.masks import (
    NUM_BINS,
    MaskScore,
    mean_score,
    measure_heatmap,
    score_heatmap,
)


def score(heatmap: np.ndarray, mask: np.ndarray) -> MaskScore:
    return mean_score([measure_heatmap(heatmap, mask)])


def test_known_answers() -> None:
    heatmap = np.array([[0.9, 0.8, 0.2, 0.4]])
    mask = np.array([[True, False, True, False]])
    loss, iou = score_heatmap(heatmap, mask)
    assert loss == pytest.approx(-np.log([0.9, 0.2, 0.2, 0.6]).mean())
    assert iou == pytest.approx(1 / 3)
    nothing = np.zeros((4, 4))
    assert score_heatmap(nothing, nothing > 0)[1] == 1, "empty masks agree"
    assert score_heatmap(nothing + 1, nothing > 0)[0] == pytest.approx(-np.log(1e-7))


def test_the_loss_is_torch_s() -> None:
    torch = pytest.importorskip("torch", reason="needs torch, which is for training only")
    rng = np.random.default_rng(0)
    logits, mask = rng.normal(0, 3, (32, 32)).astype(np.float32), rng.random((32, 32)) < 0.3
    expected = torch.nn.functional.binary_cross_entropy_with_logits(
        torch.from_numpy(logits), torch.from_numpy(mask).float()
    )
    loss, _ = score_heatmap(1 / (1 + np.exp(-logits)), mask)
    assert loss == pytest.approx(float(expected), abs=1e-5)


def test_images_count_the_same_for_the_loss_and_pixels_for_the_calibration() -> None:
    generator = np.random.default_rng(3)
    heatmap = generator.random((60, 50)).astype(np.float32)
    mask = generator.random(heatmap.shape) < 0.4
    whole = score(heatmap, mask)
    halves = [(heatmap[rows], mask[rows]) for rows in (slice(9), slice(9, None))]
    parts = mean_score([measure_heatmap(*half) for half in halves])
    assert (parts.loss, parts.iou) == pytest.approx(
        tuple(np.mean([score_heatmap(*half) for half in halves], axis=0))
    )
    assert parts.images == 2
    assert parts.calibration_error == pytest.approx(whole.calibration_error)
    assert (parts.density, parts.label_density) == (whole.density, whole.label_density)
    # Errors of opposite sign in two images do not cancel in the mean of both, but do when pooled.
    flat = np.full((4, 4), 0.5)
    both = mean_score([measure_heatmap(flat, np.full((4, 4), k > 0)) for k in (0, 1)])
    assert both.calibration_error == 0


def test_probabilities_have_the_error_by_which_they_are_wrong() -> None:
    generator = np.random.default_rng(0)
    right = generator.uniform(0.2, 0.8, (600, 500))
    mask = generator.random(right.shape) < right
    for excess in (0, 0.1, -0.05):
        found = score((right + excess).astype(np.float32), mask)
        assert found.calibration_error == pytest.approx(abs(excess), abs=0.005)
        assert found.density == pytest.approx((right + excess > 0.5).mean())
        assert found.label_density == mask.mean()


def test_the_calibration_error_is_that_of_the_definition() -> None:
    generator = np.random.default_rng(2)
    heatmap = (generator.random((40, 50)) ** 3).astype(np.float32)
    heatmap[0, :2] = 0, 1
    mask = generator.random(heatmap.shape) < 0.3
    expected = 0.0
    for number in range(NUM_BINS):
        low, high = number / NUM_BINS, (number + 1) / NUM_BINS
        inside = (heatmap >= low) & ((heatmap < high) | (number == NUM_BINS - 1))
        if inside.any():
            expected += inside.mean() * abs(heatmap[inside].mean() - mask[inside].mean())
    assert score(heatmap, mask).calibration_error == pytest.approx(expected, rel=1e-5)
