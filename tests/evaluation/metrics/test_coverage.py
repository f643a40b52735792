from __future__ import annotations

import math

import numpy as np
import pytest

from deepdetect.evaluation.metrics.coverage import coverage, foreground_fraction


def test_coverage_counts_cells_once() -> None:
    size = (64, 96)  # two by three cells
    assert coverage(np.empty((0, 2)), size) == 0
    assert coverage(np.array([[0, 0], [1, 1], [31, 31]]), size) == pytest.approx(1 / 6)
    assert coverage(np.array([[31.6, 0]]), size) == coverage(np.array([[0, 95.4]]), size) == 1 / 6
    everything = np.stack(np.meshgrid(np.arange(64), np.arange(96)), -1).reshape(-1, 2)
    assert coverage(everything, size) == 1


def test_a_cell_begins_half_a_pixel_before_its_first_centre() -> None:
    assert coverage(np.array([[31.4, 0], [0, 0]]), (64, 32)) == 0.5
    assert coverage(np.array([[31.5, 0], [0, 0]]), (64, 32)) == 1


def test_the_last_cells_may_be_smaller() -> None:
    assert coverage(np.array([[32, 0]]), (33, 10)) == 0.5


def test_foreground_fraction() -> None:
    foreground = np.zeros((4, 6), bool)
    foreground[:, 3:] = True
    points = np.array([[0, 0], [3, 0], [5, 3], [2.4, 1], [2.6, 1]])
    assert foreground_fraction(points, foreground) == 0.6
    assert math.isnan(foreground_fraction(np.empty((0, 2)), foreground))
