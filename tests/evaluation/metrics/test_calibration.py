from __future__ import annotations

import numpy as np
import pytest

from deepdetect.evaluation.metrics.calibration import NUM_BINS, calibration_of, pooled


def test_probabilities_that_are_right_have_no_error() -> None:
    generator = np.random.default_rng(0)
    heatmap = generator.random((600, 500)).astype(np.float32)
    mask = generator.random(heatmap.shape) < heatmap
    found = calibration_of(heatmap, mask)
    assert found.pixels.sum() == heatmap.size
    assert found.expected_error < 0.005  # what chance leaves of 15,000 pixels a bin
    assert found.density == pytest.approx((heatmap > 0.5).mean())
    assert found.label_density == mask.mean()


@pytest.mark.parametrize("excess", [0.1, -0.05])
def test_probabilities_that_are_wrong_have_the_error_by_which_they_are(excess: float) -> None:
    generator = np.random.default_rng(1)
    right = generator.uniform(0.2, 0.8, (600, 500))
    mask = generator.random(right.shape) < right
    found = calibration_of((right + excess).astype(np.float32), mask)
    assert found.expected_error == pytest.approx(abs(excess), abs=0.005)


def test_the_error_is_that_of_the_definition() -> None:
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
    assert calibration_of(heatmap, mask).expected_error == pytest.approx(expected, rel=1e-5)


def test_images_are_pooled_pixel_by_pixel() -> None:
    generator = np.random.default_rng(3)
    heatmap = generator.random((60, 50)).astype(np.float32)
    mask = generator.random(heatmap.shape) < 0.4
    whole = calibration_of(heatmap, mask)
    parts = pooled(calibration_of(heatmap[rows], mask[rows]) for rows in (slice(9), slice(9, None)))
    assert parts.values() == pytest.approx(whole.values())
    # Errors of opposite sign in two images do not cancel in the mean of both, but do when pooled.
    both = pooled([calibration_of(np.full((4, 4), 0.5), np.full((4, 4), k > 0)) for k in (0, 1)])
    assert both.expected_error == 0
