from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from skimage import data

from deepdetect.io.image import luma
from deepdetect_lab.labels import (
    DETECTOR_NAMES,
    LabelOptions,
    fuse,
    visibility_of,
)
from deepdetect_lab.training import augmentation
from deepdetect_lab.training.augmentation import (
    Darkening,
    augment,
    darken,
    draw_darkening,
    draw_exposure,
    rotate_hue,
    transpose,
)

IMAGES = arrays(np.uint8, (6, 7, 3))


@pytest.mark.parametrize("name", DETECTOR_NAMES)
def test_a_transposed_photograph_has_the_transposed_label(name: str, photo: np.ndarray) -> None:
    options = LabelOptions((name,))
    mask = fuse(luma(photo), options).mask
    turned, expected = transpose(photo, mask)
    found = fuse(luma(turned), options).mask
    # BRISK's scale space is not quite the same along both axes.
    assert (found & expected).sum() >= (0.9 if name == "brisk" else 0.999) * (
        found | expected
    ).sum()


@given(image=IMAGES, angle=st.floats(0, 7), saturation=st.floats(0, 2))
def test_other_colors_have_the_same_luma(
    image: np.ndarray, angle: float, saturation: float
) -> None:
    turned = rotate_hue(image, angle, saturation)
    assert turned.dtype == np.uint8
    assert np.abs(luma(turned).astype(int) - luma(image)).max() <= 1


@pytest.fixture(scope="module")
def photos() -> dict[str, np.ndarray]:
    return {
        "astronaut": np.ascontiguousarray(data.astronaut()[::4, ::4]),
        "chelsea": np.ascontiguousarray(data.chelsea()[::3, ::3]),
        "coffee": np.ascontiguousarray(data.coffee()[::5, ::5]),
    }


@pytest.mark.parametrize("name", ["astronaut", "chelsea", "coffee"])
def test_a_darkened_photograph_is_of_low_visibility(name: str, photos: dict) -> None:
    assert visibility_of(luma(photos[name])) == "normal"
    for brightness, contrast in ((0.2, 0.55), (0.45, 0.3), (0.45, 0.55)):
        dark = darken(photos[name], Darkening(brightness, contrast))
        assert visibility_of(luma(dark)) == "low"
        assert dark.mean() < photos[name].mean() / 2


@given(seed=st.integers(0, 2**32 - 1))
def test_the_widest_image_is_of_low_visibility_too(seed: int) -> None:
    generator = np.random.default_rng(seed)
    extreme = generator.choice(np.array([0, 255], np.uint8), (16, 16, 3))
    for draw in (draw_darkening, draw_exposure):
        assert visibility_of(luma(darken(extreme, draw(generator)))) == "low"


@given(seed=st.integers(0, 2**32 - 1))
def test_a_short_exposure_keeps_its_contrast(seed: int) -> None:
    bright = np.linspace(0, 255, 3 * 64).astype(np.uint8).reshape(8, 8, 3)
    exposure = draw_exposure(np.random.default_rng(seed))
    np.testing.assert_allclose(darken(bright, exposure), bright * exposure.brightness, atol=1)


@given(
    height=st.integers(20, 200),
    width=st.integers(20, 200),
    side=st.integers(16, 160),
    seed=st.integers(0, 2**32 - 1),
)
def test_any_photograph_gives_a_square(height: int, width: int, side: int, seed: int) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    view = augment(rgb, side, seed)
    assert view.shape == (side, side, 3)
    assert view.dtype == np.uint8
    np.testing.assert_array_equal(view, augment(rgb, side, seed))


def test_all_of_it_comes_from_inside() -> None:
    """The places that a view is sampled from, seen in two ramps."""
    rows, columns = np.mgrid[0:200, 0:240].astype(np.uint8)
    ramps = np.dstack([columns, rows, np.zeros_like(rows)])
    edges = []
    for seed in range(60):
        generator = np.random.default_rng(seed)
        view = augmentation._rotated_crop(ramps, 100, generator).astype(float)
        across = view[50, 75, :2] - view[50, 25, :2]
        down = view[75, 50, :2] - view[25, 50, :2]
        # Rotated, and scaled equally along both axes, and not mirrored.
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


def test_views_that_are_not_turned_keep_the_pixels_of_an_image_of_their_size() -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (96, 96, 3), np.uint8)
    turned = [np.rot90(rgb[:, ::step], k) for step in (1, -1) for k in range(4)]
    drawn = set()
    for seed in range(60):
        view = augmentation._upright_crop(rgb, 96, np.random.default_rng(seed))
        drawn |= {k for k, expected in enumerate(turned) if np.array_equal(view, expected)}
        assert any(np.array_equal(view, expected) for expected in turned)
    assert drawn == set(range(8))


def test_views_that_are_not_turned_are_cut_from_the_sizes_asked_for() -> None:
    rows, columns = np.mgrid[0:200, 0:240].astype(np.uint8)
    scales = []
    for seed in range(60):
        view = augmentation._upright_crop(
            np.dstack([columns, rows, rows]), 100, np.random.default_rng(seed)
        ).astype(float)
        across, down = view[50, 75, :2] - view[50, 25, :2], view[75, 50, :2] - view[25, 50, :2]
        assert np.count_nonzero(across) == np.count_nonzero(down) == 1
        assert np.linalg.norm(across) == pytest.approx(np.linalg.norm(down), abs=2)
        scales.append(np.linalg.norm(across) / 50)
    assert min(scales) == pytest.approx(1.4, abs=0.1)  # CROP_SCALE of the shorter side
    assert max(scales) == pytest.approx(2, abs=0.1)
