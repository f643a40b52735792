from __future__ import annotations

import numpy as np
import pytest

from deepdetect.io.image import luma
from deepdetect.matching.guided.cells import (
    describe,
    gathered,
    mean_around,
    predicted,
    shown_parts,
)

AFFINE = np.array([[1.1, 0.1, 4.0], [-0.05, 0.9, 7.0]])


def test_an_image_correlates_with_itself_and_not_with_its_mirror(photo: np.ndarray) -> None:
    cells, mirrored = (
        each.reshape(*shape, -1)
        for each, shape in (describe(luma(photo)), describe(luma(photo)[:, ::-1].copy()))
    )
    here = np.zeros((*cells.shape[:2], 2))
    valid = np.ones(cells.shape[:2], bool)
    own = gathered(cells, cells, valid, here)
    assert (own[1:-1, 1:-1] > 0.999).mean() > 0.99  # the others are flat
    assert np.isnan(own[0, 0])  # a corner has too few neighbours
    assert np.nanmedian(gathered(cells, mirrored, valid, here)) < 0.2


def test_displaced_cells_are_those_of_a_displaced_image(photo: np.ndarray) -> None:
    gray = luma(photo)
    wide, shape = describe(gray)
    cells = wide.reshape(*shape, -1)
    field = np.zeros((*shape, 2)) + [3, -2]
    moved = gathered(cells, cells, np.ones(shape, bool), field)
    assert np.isnan(moved[:2]).all()
    assert np.isnan(moved[:, -3:]).all()
    inner = (cells[4:-1, 1:-5] * cells[2:-3, 4:-2]).sum(2)
    around = sum(
        inner[1 + j : -1 + j or None, 1 + i : -1 + i or None]
        for j in (-1, 0, 1)
        for i in (-1, 0, 1)
    )
    np.testing.assert_allclose(moved[5:-2, 2:-6], around / 9, atol=1e-4)


def test_affine_motion_is_predicted_exactly() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(0, (120, 90), (900, 2))
    ends, known = predicted(points, points @ AFFINE[:, :2].T + AFFINE[:, 2], (90, 120))
    y, x = np.indices((90, 120))
    expected = np.dstack([x, y]) @ AFFINE[:, :2].T + AFFINE[:, 2]
    assert known[20:70, 20:100].all()
    np.testing.assert_allclose(ends[known], expected[known], atol=1e-3)


@pytest.mark.parametrize("size", [(90, 120), (30, 200)])
def test_places_without_matches_around_are_unknown(size: tuple[int, int]) -> None:
    points = np.stack(np.meshgrid(np.arange(24), np.arange(24)), -1).reshape(-1, 2).astype(float)
    _, known = predicted(points, points, size)
    assert not known[:, 60:].any()


def test_means_leave_out_what_is_unknown() -> None:
    values = np.full((40, 40), 2.0)
    values[:, 20:] = np.nan
    means = mean_around(values)
    np.testing.assert_allclose(means[:, :20], 2)
    assert np.isnan(means[:, 20:]).all()


def test_a_mask_is_enlarged_by_a_margin() -> None:
    mask = np.zeros((100, 100), bool)
    mask[50, 50] = True
    shown = shown_parts(mask, (100, 100))
    assert not shown[42:59, 42:59].any()
    assert not shown[0].any()
    assert shown[20, 20]
