from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image, ImageEnhance

from deepdetect._shared.errors import OptionError
from deepdetect.io.image import load_image, luma
from deepdetect.labels import LOW_VISIBILITY_RANGE, luma_range, visibility_of
from deepdetect.training.darkening import Darkening, DarkeningRange, darken

FACTORS = st.floats(0.01, 1) | st.integers(1, 1000).map(lambda n: n / 1000)
RANGE = DarkeningRange()


def by_pillow(rgb: np.ndarray, darkening: Darkening) -> np.ndarray:
    dim = ImageEnhance.Brightness(Image.fromarray(rgb)).enhance(darkening.brightness)
    return np.asarray(ImageEnhance.Contrast(dim).enhance(darkening.contrast))


@pytest.fixture(scope="module")
def photos() -> dict[str, np.ndarray]:
    data = pytest.importorskip("skimage.data", reason="needs scikit-image for its photographs")
    return {
        "astronaut": np.ascontiguousarray(data.astronaut()[::4, ::4]),
        "chelsea": np.ascontiguousarray(data.chelsea()[::3, ::3]),
        "coffee": np.ascontiguousarray(data.coffee()[::5, ::5]),
    }


PHOTOS = ("astronaut", "chelsea", "coffee")


@pytest.mark.parametrize("name", PHOTOS)
@pytest.mark.parametrize(
    ("brightness", "contrast"),
    [
        (0.3, 0.4),
        (1, 1),
        (1, 0.4),
        (0.3, 1),
        (0.2, 0.3),
        (0.45, 0.55),
        (0.001, 0.001),
        (0.999, 0.5),
    ],
)
def test_equals_pillow(name: str, brightness: float, contrast: float, photos: dict) -> None:
    darkening = Darkening(brightness, contrast)
    dark = darken(photos[name], darkening)
    assert dark.dtype == np.uint8
    assert dark.shape == photos[name].shape
    np.testing.assert_array_equal(dark, by_pillow(photos[name], darkening))


@pytest.mark.parametrize("name", PHOTOS)
@given(brightness=FACTORS, contrast=FACTORS)
def test_equals_pillow_for_any_factors(
    name: str, photos: dict, brightness: float, contrast: float
) -> None:
    darkening = Darkening(brightness, contrast)
    np.testing.assert_array_equal(
        darken(photos[name], darkening), by_pillow(photos[name], darkening)
    )


def test_equals_pillow_where_the_mean_is_near_a_half(photos: dict) -> None:
    # Pillow's luma and OpenCV's differ in a few colours, which can move the rounded mean.
    darkening = Darkening(0.519637822662576, 0.11474348861540308)
    np.testing.assert_array_equal(
        darken(photos["coffee"], darkening), by_pillow(photos["coffee"], darkening)
    )


@pytest.mark.parametrize(
    ("colour", "brightness", "contrast"),
    [((146, 139, 247), 0.73, 0.49), ((0, 207, 35), 1, 0.4), ((200, 200, 200), 0.3, 0.4)],
)
def test_equals_pillow_on_one_colour(
    colour: tuple[int, int, int], brightness: float, contrast: float
) -> None:
    rgb = np.broadcast_to(np.array(colour, np.uint8), (16, 16, 3)).copy()
    darkening = Darkening(brightness, contrast)
    np.testing.assert_array_equal(darken(rgb, darkening), by_pillow(rgb, darkening))


@given(
    rgb=arrays(np.uint8, st.tuples(st.integers(1, 6), st.integers(1, 6), st.just(3))),
    brightness=FACTORS,
    contrast=FACTORS,
)
def test_equals_pillow_on_any_image(rgb: np.ndarray, brightness: float, contrast: float) -> None:
    darkening = Darkening(brightness, contrast)
    np.testing.assert_array_equal(darken(rgb, darkening), by_pillow(rgb, darkening))


@pytest.mark.parametrize("name", PHOTOS)
@pytest.mark.parametrize("brightness", [RANGE.brightness[0], 0.3, RANGE.brightness[1]])
@pytest.mark.parametrize("contrast", [RANGE.contrast[0], 0.4, RANGE.contrast[1]])
def test_a_darkened_photograph_is_of_low_visibility(
    name: str, brightness: float, contrast: float, photos: dict
) -> None:
    dark = darken(photos[name], Darkening(brightness, contrast))
    assert visibility_of(luma(photos[name])) == "normal"
    assert visibility_of(luma(dark)) == "low"
    assert dark.mean() < photos[name].mean() / 2


def test_darkened_training_photographs_are_of_low_visibility(shared: object) -> None:
    generator = np.random.default_rng(0)
    paths = sorted((shared / "data" / "photos" / "val").glob("*.jpg"))[::25]
    assert len(paths) > 5
    for path in paths:
        dark = darken(load_image(path), RANGE.draw(generator))
        assert visibility_of(luma(dark)) == "low", path.name


@given(seed=st.integers(0, 2**32 - 1))
def test_the_widest_image_is_of_low_visibility_too(seed: int) -> None:
    generator = np.random.default_rng(seed)
    extreme = generator.choice(np.array([0, 255], np.uint8), (16, 16, 3))
    dark = darken(extreme, RANGE.draw(generator))
    assert luma_range(luma(dark)) < LOW_VISIBILITY_RANGE


@given(seed=st.integers(0, 2**32 - 1))
def test_drawn_factors(seed: int) -> None:
    drawn = RANGE.draw(np.random.default_rng(seed))
    assert RANGE.brightness[0] <= drawn.brightness <= RANGE.brightness[1]
    assert RANGE.contrast[0] <= drawn.contrast <= RANGE.contrast[1]
    assert drawn.brightness * drawn.contrast < 0.25
    assert drawn == Darkening(float(f"{drawn.brightness:.3f}"), float(f"{drawn.contrast:.3f}"))
    assert RANGE.draw(np.random.default_rng(seed)) == drawn


def test_draws_fill_the_ranges() -> None:
    generator = np.random.default_rng(0)
    drawn = [RANGE.draw(generator) for _ in range(400)]
    for name in ("brightness", "contrast"):
        low, high = getattr(RANGE, name)
        values = [getattr(one, name) for one in drawn]
        assert min(values) < low + 0.05 * (high - low)
        assert max(values) > high - 0.05 * (high - low)


@pytest.mark.parametrize("factor", [0, -0.1, 1.001, float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["brightness", "contrast"])
def test_factors_out_of_range(name: str, factor: float) -> None:
    with pytest.raises(OptionError, match=f"{name} must be above 0 and at most 1"):
        Darkening(**{"brightness": 0.5, "contrast": 0.5} | {name: factor})


def test_the_photograph_is_left_as_it_was(photos: dict) -> None:
    before = photos["coffee"].copy()
    darken(photos["coffee"], Darkening(0.3, 0.4))
    np.testing.assert_array_equal(photos["coffee"], before)
