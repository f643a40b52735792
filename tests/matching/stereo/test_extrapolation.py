"""Disparities extrapolated to the border, where the truth is known."""

from __future__ import annotations

import numpy as np
import pytest

from deepdetect.matching.stereo.extrapolation import extrapolate_disparity

SHAPE = (6, 80)
COLUMN = np.arange(SHAPE[1])


def extrapolated(
    disparity: np.ndarray, known: np.ndarray, carried: np.ndarray | None = None
) -> np.ndarray:
    """Extrapolate surfaces that all paths carry on."""
    if carried is None:
        ends = (known.argmax(1), known.shape[1] - 1 - known[:, ::-1].argmax(1))
        first, last = (disparity[np.arange(len(known)), end][:, None] for end in ends)
        carried = np.where(np.arange(known.shape[1]) < ends[0][:, None], first, last)
    return extrapolate_disparity(disparity, known, carried.astype(np.float32))


def on_rows(values: np.ndarray) -> np.ndarray:
    return np.tile(np.asarray(values, np.float32), (SHAPE[0], 1))


@pytest.mark.parametrize("slope", [0, 0.1, -0.2])
@pytest.mark.parametrize("right", [False, True], ids=["left border", "right border"])
def test_a_plane_is_extrapolated_to_the_border(slope: float, right: bool) -> None:
    surface = 15 + slope * COLUMN
    surface = -surface[::-1] if right else surface
    place = COLUMN - surface
    seen = (place >= 0) & (place <= SHAPE[1] - 1)
    found = extrapolated(on_rows(surface), on_rows(seen) > 0)
    np.testing.assert_array_equal(np.isfinite(found), on_rows(~seen) > 0)
    np.testing.assert_allclose(found[:, ~seen], on_rows(surface)[:, ~seen], atol=1e-4)


def test_what_the_other_view_would_show_stays_open() -> None:
    """It has no match, so something else is there."""
    found = extrapolated(on_rows(np.full(80, 4)), on_rows(COLUMN >= 10) > 0)
    np.testing.assert_array_equal(np.isfinite(found), on_rows(COLUMN < 4) > 0)
    assert np.isnan(extrapolated(on_rows(np.full(80, 4)), on_rows(COLUMN < 70) > 0)).all()


def test_a_surface_is_extrapolated_half_as_far_as_it_is_seen() -> None:
    surface = np.where(COLUMN < 50, 40, 20)  # 20 px of it are seen
    found = extrapolated(on_rows(surface), on_rows(COLUMN >= 30) > 0)
    np.testing.assert_array_equal(np.isfinite(found), on_rows((COLUMN >= 20) & (COLUMN < 30)) > 0)


def test_a_bent_surface_is_extrapolated_less_far() -> None:
    reach = []
    for bend in (0, 0.005, 0.02):
        surface = 30 + bend * (COLUMN - 30.0) ** 2
        found = extrapolated(on_rows(surface), on_rows(COLUMN >= 30) > 0)
        given = np.isfinite(found[0])
        reach.append(int(given.sum()))
        assert (np.abs(found[0] - surface)[given] < 2).all()
    assert reach[0] > 20
    assert reach[0] > reach[1] > reach[2] > 0


def test_too_little_is_not_extrapolated() -> None:
    known = on_rows((COLUMN >= 20) & (COLUMN < 27)) > 0
    surface = on_rows(np.full(80, 25))
    assert np.isnan(extrapolated(surface, known)).all()
    assert np.isfinite(extrapolated(surface, on_rows((COLUMN >= 20) & (COLUMN < 30)) > 0)).any()
    assert np.isnan(extrapolated(surface, np.zeros(SHAPE, bool))).all()
    assert np.isnan(extrapolated(surface, np.ones(SHAPE, bool))).all()


def test_where_other_paths_bring_another_surface_there_is_none() -> None:
    surface = on_rows(np.full(80, 20))
    known = on_rows(COLUMN >= 20) > 0
    carried = surface.copy()
    carried[:2] = 28
    carried[2:, 5:8] = 12
    found = extrapolated(surface, known, carried)
    np.testing.assert_array_equal(np.isfinite(found), ~known & (carried == 20))


def test_unknown_pixels_do_not_count() -> None:
    surface = on_rows(15 + 0.1 * COLUMN)
    known = (COLUMN >= 17) & (COLUMN % 3 > 0)
    wild = np.where(known, surface, np.float32(1e6))
    found = extrapolated(wild, on_rows(known) > 0)
    np.testing.assert_allclose(found[:, :16], surface[:, :16], atol=1e-3)
