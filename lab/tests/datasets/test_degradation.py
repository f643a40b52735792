"""Dark and blurred copies beside what their models say."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from deepdetect_lab.datasets.degradation import (
    DEGRADATIONS,
    blur_gaussian,
    blur_motion,
    degrade,
    motion_kernel,
    to_linear,
    to_srgb,
)


@pytest.mark.parametrize("name", DEGRADATIONS)
def test_the_same_image_has_the_same_copy_and_another_image_others(
    name: str, photo: np.ndarray
) -> None:
    one = DEGRADATIONS[name]
    assert one.name == name
    copy = degrade(photo, one)
    assert (copy.shape, copy.dtype) == (photo.shape, np.uint8)
    np.testing.assert_array_equal(degrade(photo, one), copy)
    flipped = degrade(photo[:, ::-1].copy(), one)[:, ::-1]
    assert (flipped != copy).any() or name == "blur-2"


@pytest.mark.parametrize(("fraction", "name"), [(1 / 4, "dark-4"), (1 / 8, "dark-8")])
def test_light_is_divided_and_noise_is_that_of_the_sensor(fraction: float, name: str) -> None:
    for value in (60, 128, 255):
        gray = np.full((200, 200, 3), value, np.uint8)
        light = float(to_linear(gray)[0, 0, 0])
        found = to_linear(degrade(gray, DEGRADATIONS[name])).astype(float)
        assert found.mean() == pytest.approx(light * fraction, rel=0.02)
        electrons = light * fraction * 10_000
        expected = np.sqrt(electrons + 3**2) / 10_000
        # Eight bits add some of their own.
        step = np.diff(to_linear(np.array([0, 1]) + degrade(gray, DEGRADATIONS[name])[0, 0, 0]))
        assert found.std() == pytest.approx(np.hypot(expected, step[0] / np.sqrt(12)), rel=0.1)


def test_the_gamma_is_undone_and_applied() -> None:
    every = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(to_srgb(to_linear(every)), every)
    assert to_linear(every)[[0, 255]].tolist() == [0, 1]
    assert to_linear(every)[188] == pytest.approx(0.5, abs=0.005)


def test_blurs_are_in_linear_light_and_do_not_move_the_image(photo: np.ndarray) -> None:
    linear = to_linear(photo)
    smooth = ndimage.gaussian_filter(linear, (2, 2, 0), mode="mirror")
    found = blur_gaussian(linear, np.random.default_rng(0), 2)
    assert np.abs(found.astype(int) - to_srgb(smooth))[10:-10, 10:-10].max() <= 1
    spot = np.zeros((41, 41, 3), np.float32)
    spot[20, 20] = 1
    for seed in range(4):
        light = to_linear(blur_motion(spot, np.random.default_rng(seed), 9))[..., 0]
        row, column = np.indices(light.shape)
        assert (light * row).sum() / light.sum() == pytest.approx(20, abs=0.02)
        assert (light * column).sum() / light.sum() == pytest.approx(20, abs=0.02)


@pytest.mark.parametrize("angle", [0, 0.3, np.pi / 4, np.pi / 2, 2.5])
@pytest.mark.parametrize("length", [3, 9])
def test_the_kernel_is_a_line_of_its_length(angle: float, length: float) -> None:
    kernel = motion_kernel(length, angle)
    np.testing.assert_allclose(kernel, kernel[::-1, ::-1], atol=1e-12)
    row, column = np.indices(kernel.shape) - kernel.shape[0] // 2
    along = np.cos(angle) * column + np.sin(angle) * row
    across = np.cos(angle) * row - np.sin(angle) * column
    assert kernel.sum() == pytest.approx(1)
    # Splitting each point among four pixels widens it by less than half a pixel.
    assert length**2 / 12 <= (kernel * along**2).sum() < length**2 / 12 + 0.26
    assert (kernel * across**2).sum() < 0.26
