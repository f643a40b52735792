from __future__ import annotations

import io
import math

import cv2
import numpy as np
import pytest
from PIL import Image

from deepdetect_lab.training.synthetic import (
    Camera,
    Effect,
    Light,
    blur,
    compress,
    happens,
    record,
    relight,
    rotation,
    scaled_along,
    view_homography,
)

RAMP = np.linspace(0, 1, 64, dtype=np.float32)[None].repeat(64, 0)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_effects_happen_as_often_and_as_strongly_as_they_say() -> None:
    generator, effect = rng(), Effect(0.3, 2, 6, power=2)
    assert np.mean([effect.happens(generator) for _ in range(4000)]) == pytest.approx(0.3, abs=0.03)
    strengths = [effect.strength(generator) for _ in range(4000)]
    assert 2 <= min(strengths) < max(strengths) <= 6
    assert np.mean(strengths) == pytest.approx(2 + 4 / 3, abs=0.1)
    assert {effect.whole(generator) for _ in range(99)} == {2, 3, 4, 5}
    before = generator.bit_generator.state
    assert happens(generator, 1)
    assert not happens(generator, 0)
    assert generator.bit_generator.state == before, "what is certain is not drawn"


def test_light_follows_its_formulas() -> None:
    np.testing.assert_array_equal(relight(rng(), RAMP, Light()), RAMP)
    gamma = relight(rng(), RAMP, Light(log_gamma=Effect(1, 0.5, 0.5)))
    np.testing.assert_allclose(gamma, RAMP ** math.exp(0.5), rtol=1e-5)
    contrast = relight(rng(), RAMP, Light(contrast=Effect(1, 0.4, 0.4), shift=(0.1, 0.1)))
    np.testing.assert_allclose(contrast, (RAMP - 0.5) * 0.4 + 0.6, rtol=1e-5)
    gain = relight(rng(), RAMP, Light(log_gain=Effect(1, -1, -1)))
    np.testing.assert_allclose(gain, RAMP / math.e, rtol=1e-5)
    curve = relight(rng(), RAMP, Light(curve=1))
    assert (curve[0, 0], curve[0, -1]) == (0, 1)
    assert (np.diff(curve[0]) >= 0).all()


def test_fields_ramps_and_shadows_vary_over_the_view() -> None:
    flat = np.full((64, 64), 0.5, np.float32)
    for kind, limits in (("field", (0.29, 0.71)), ("ramp", (0.2, 0.8)), ("shadow", (0.29, 0.51))):
        seen = [relight(rng(k), flat, Light(**{kind: Effect(1, 0.4, 0.4)})) for k in range(20)]
        assert max(np.ptp(each) for each in seen) > 0.1
        assert limits[0] <= np.min(seen) < np.max(seen) <= limits[1]


def test_blur_and_motion_spread_a_spot() -> None:
    spot = np.zeros((41, 41), np.float32)
    spot[20, 20] = 1
    found = blur(rng(), spot, Camera(blur=Effect(1, 2, 2)))
    np.testing.assert_allclose(found, cv2.GaussianBlur(spot, (0, 0), 2), atol=1e-6)
    lines = [blur(rng(k), spot, Camera(motion=Effect(1, 9, 10))) for k in range(9)]
    for line in lines:
        assert line.sum() == pytest.approx(1, abs=1e-4)
        assert 9 <= (line > 0.01).sum() < 40


def test_noise_is_as_strong_as_asked_for_and_darkness_as_dark() -> None:
    flat = np.full((128, 128), 120, np.float32)
    noisy = record(rng(), flat, Camera(noise=(Effect(0, 50, 50), Effect(1, 6, 6))))
    assert noisy.dtype == np.uint8
    assert noisy.std() == pytest.approx(6, rel=0.05)
    dark = record(rng(), flat, Camera(log_dark=Effect(1, math.log(0.2), math.log(0.2))))
    assert dark.mean() == pytest.approx(24, abs=0.5)
    assert 0.2 < dark.std() < 3.1
    np.testing.assert_array_equal(record(rng(), flat, Camera()), 120)


def test_compression_is_that_of_pillow(photo: np.ndarray) -> None:
    """Channels in their order: with red and blue swapped the luma would lose more."""
    file = io.BytesIO()
    Image.fromarray(photo).save(file, "JPEG", quality=30)
    expected = np.asarray(Image.open(file)).astype(int)
    found = compress(photo, 30).astype(int)
    assert np.abs(found - expected).mean() < 2
    assert np.abs(found - photo).mean() > 2
    gray = compress(photo[..., 0].copy(), 30)
    assert 0 < np.abs(gray.astype(int) - photo[..., 0]).mean() < 10


def test_the_middle_of_a_view_shows_its_place() -> None:
    linear = rotation(0.3) @ scaled_along(1.0, 2.0, 0.5)
    matrix = view_homography(65, np.array([10.0, 20.0]), linear, np.array([1e-3, 0]))
    np.testing.assert_allclose(matrix @ [32, 32, 1], [10, 20, 1])
    x, y, w = matrix @ [33, 32, 1]
    np.testing.assert_allclose((x / w - 10, y / w - 20), linear[:, 0] / 1.001)
    assert np.linalg.det(scaled_along(0.7, 3.0, 1.0)) == pytest.approx(3)
