from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect.features.selection import GRID_CELLS, spread_over_grid
from deepdetect.features.sift import detect_sift
from deepdetect.io.image import luma


def blob(x: float, y: float, sigma: float, shape: tuple[int, int] = (120, 140)) -> np.ndarray:
    """A bright spot on dark ground."""
    row, column = np.indices(shape)
    away = (column - x) ** 2 + (row - y) ** 2
    return np.rint(40 + 180 * np.exp(-away / (2 * sigma**2))).astype(np.uint8)


def cells_of(xy: np.ndarray, size: tuple[int, int]) -> list[tuple[int, int]]:
    side = max(size) / GRID_CELLS
    return [(int(x // side), int(y // side)) for x, y in xy]


@pytest.mark.parametrize("sigma", [2.0, 4.0])
@pytest.mark.parametrize(("x", "y"), [(60, 50), (80.3, 41.7)])
def test_a_blob_is_found_at_its_centre(x: float, y: float, sigma: float) -> None:
    """The centre of the first pixel is (0, 0)."""
    found = detect_sift(blob(x, y, sigma)).xy
    assert len(found)
    np.testing.assert_allclose(found, np.broadcast_to([x, y], found.shape), atol=0.1)


def test_there_is_one_descriptor_for_each_position(photo: np.ndarray) -> None:
    gray = luma(photo)
    found = detect_sift(gray)
    assert 100 < len(found) == len(found.xy) == len(found.descriptors) <= 4000
    assert found.xy.dtype == np.float32
    assert found.descriptors.dtype == np.uint8
    assert found.descriptors.shape[1] == 128
    assert (found.xy >= 0).all()
    assert (found.xy <= np.array(gray.shape[::-1]) - 1).all()
    # RootSIFT: square roots of shares that sum to 1 have the norm 1, here times 512.
    norms = np.linalg.norm(found.descriptors.astype(float), axis=1)
    np.testing.assert_allclose(norms, 512, rtol=0.01)


def test_descriptors_turn_with_the_image(photo: np.ndarray) -> None:
    gray = luma(photo)
    upright, turned = detect_sift(gray), detect_sift(np.rot90(gray).copy())
    first, second = (each.descriptors.astype(np.float32) for each in (upright, turned))
    nearest = ((first**2).sum(1)[:, None] + (second**2).sum(1) - 2 * first @ second.T).argmin(1)
    # A quarter turn takes the pixel (x, y) to (y, W - 1 - x).
    there = np.column_stack([upright.xy[:, 1], gray.shape[1] - 1 - upright.xy[:, 0]])
    gap = np.linalg.norm(turned.xy[nearest] - there, axis=1)
    assert (gap < 1).mean() > 0.8


@pytest.mark.parametrize("most", [0, 1, 7, 120])
def test_there_are_no_more_than_asked_for(photo: np.ndarray, most: int) -> None:
    assert len(detect_sift(luma(photo), most)) == most


def test_faint_parts_have_keypoints_too(photo: np.ndarray) -> None:
    """The strongest of all would nearly all be right of the middle."""
    gray = luma(photo)
    gray[:, :128] = 90 + gray[:, :128] // 4
    xy = detect_sift(gray, 150).xy
    assert (xy[:, 0] < 120).mean() > 0.15


@pytest.mark.parametrize("shape", [(1, 1), (5, 5), (1, 9), (64, 80)])
def test_a_flat_image_has_no_keypoints(shape: tuple[int, int]) -> None:
    found = detect_sift(np.full(shape, 90, np.uint8))
    assert found.xy.shape == (0, 2)
    assert found.descriptors.shape == (0, 128)
    assert found.descriptors.dtype == np.uint8


@given(
    count=st.integers(0, 80),
    most=st.integers(0, 90),
    size=st.tuples(st.integers(1, 500), st.integers(1, 500)),
    clumped=st.floats(0, 3),
    seed=st.integers(0, 2**32 - 1),
)
def test_spread_takes_cells_in_turn(
    count: int, most: int, size: tuple[int, int], clumped: float, seed: int
) -> None:
    generator = np.random.default_rng(seed)
    xy = generator.random((count, 2)) ** (1 + clumped) * size
    strength = generator.permutation(count).astype(float)
    rows = spread_over_grid(xy, strength, size, most).tolist()
    assert len(rows) == len(set(rows)) == min(count, most)
    cell = cells_of(xy, size)
    waiting = {
        one: sorted((k for k in range(count) if cell[k] == one), key=lambda k: -strength[k])
        for one in set(cell)
    }
    expected = []
    while any(waiting.values()):
        turn = [members.pop(0) for members in waiting.values() if members]
        expected += sorted(turn, key=lambda k: -strength[k])
    assert rows == expected[:most]
