from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from deepdetect._shared.errors import OptionError
from deepdetect.datasets.types import read_homography
from deepdetect.evaluation.metrics.homography_accuracy import corner_error
from deepdetect.geometry.homography_refinement import RefinementOptions, refine_homography
from deepdetect.io.image import load_image, luma

TRUE = np.array([[0.95, 0.06, 9.0], [-0.04, 1.02, 5.0], [8e-5, -5e-5, 1.0]])


@pytest.fixture(scope="module")
def pair(photo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A photograph, and the same seen through `TRUE` in other light."""
    gray = luma(photo)
    moved = cv2.warpPerspective(gray, TRUE, (256, 256), flags=cv2.INTER_CUBIC)
    return gray, np.clip(moved * 0.6 + 30, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("seed", range(4))
def test_finds_the_true_homography_from_some_pixels_away(
    pair: tuple[np.ndarray, np.ndarray], seed: int
) -> None:
    generator = np.random.default_rng(seed)
    start = TRUE.copy()
    start[:2, 2] += generator.uniform(-4, 4, 2)
    start[:2, :2] += generator.uniform(-0.01, 0.01, (2, 2))
    assert corner_error(start, TRUE, (256, 256)) > 1
    found = refine_homography(*pair, start)
    assert corner_error(found.homography, TRUE, (256, 256)) < 0.25
    assert found.agreement > found.before
    assert found.steps >= 1
    assert found.homography[2, 2] == 1


def test_never_makes_it_worse(pair: tuple[np.ndarray, np.ndarray]) -> None:
    found = refine_homography(*pair, TRUE)
    assert found.agreement >= found.before
    assert corner_error(found.homography, TRUE, (256, 256)) < 0.25


def test_keeps_what_it_is_given_where_nothing_can_be_tracked() -> None:
    flat = np.full((64, 64), 90, np.uint8)
    start = np.array([[1.0, 0, 2], [0, 1, 0], [0, 0, 1]])
    found = refine_homography(flat, flat, start)
    np.testing.assert_array_equal(found.homography, start)
    assert found.steps == 0


def test_is_the_same_on_repetition(pair: tuple[np.ndarray, np.ndarray]) -> None:
    start = TRUE @ np.array([[1.0, 0, 2], [0, 1, -1], [0, 0, 1]])
    first, second = (refine_homography(*pair, start).homography for _ in range(2))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize(
    "wrong", [{"rounds": 0}, {"corners": 5}, {"windows": ()}, {"windows": (3,)}, {"blurs": (0,)}]
)
def test_options_out_of_range_are_refused(wrong: dict) -> None:
    with pytest.raises(OptionError):
        RefinementOptions(**wrong)


@pytest.mark.parametrize(
    ("name", "median", "largest"),
    [("wall-2", 0.1, 0.3), ("bark-3", 0.1, 0.3), ("bikes-6", 0.3, 1.0), ("graf-6", 0.3, 1.6)],
)
def test_agrees_with_the_refined_homographies_of_oxford(
    shared: Path, name: str, median: float, largest: float
) -> None:
    """From the published one, whose points are up to 5 px off."""
    from deepdetect.evaluation.protocols.refine_oxford import displacement

    scene, number = name.split("-")
    folder = shared / "data" / "oxford" / scene
    images = [load_image(folder / f"img{k}.png") for k in (1, int(number))]
    published = read_homography(folder / f"H1to{number}p")
    expected = read_homography(folder / f"H1to{number}p.refined")
    found = refine_homography(*map(luma, images), published)
    sizes = [(image.shape[1], image.shape[0]) for image in images]
    assert displacement(expected, published, *sizes)[0] > median
    found_median, found_largest = displacement(expected, found.homography, *sizes)
    assert found_median < median
    assert found_largest < largest


def test_moving_parts_have_no_say(pair: tuple[np.ndarray, np.ndarray]) -> None:
    first, second = pair
    moved = second.copy()
    moved[60:160, 70:150] = np.roll(second[60:160, 70:150], 2, axis=1)
    start = TRUE @ np.array([[1.0, 0, 0.6], [0, 1, -0.5], [0, 0, 1]])
    found = refine_homography(first, moved, start, RefinementOptions(windows=(21,)))
    assert corner_error(found.homography, TRUE, (256, 256)) < 0.3
