from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from deepdetect.datasets.middlebury import load_middlebury
from deepdetect.errors import ReconstructionError
from deepdetect.reconstruction.calibration import Calibration, Camera
from deepdetect.reconstruction.row_degeneracy import (
    LEAST_MATCHED,
    LEAST_SURE,
    check_depths,
    check_disparities,
    check_matched,
)


@pytest.mark.parametrize(("sure", "least"), [(True, LEAST_SURE), (False, LEAST_MATCHED)])
def test_few_matches_are_told_with_their_number(sure: bool, least: float, one_line) -> None:
    enough = int(np.ceil(least * 10_000))
    check_matched(enough, 10_000, sure)
    with pytest.raises(ReconstructionError, match=f"only {enough - 1:,} of 10,000") as error:
        check_matched(enough - 1, 10_000, sure)
    one_line(error.value)


def test_disparities_that_do_not_differ(shared: Path, one_line) -> None:
    noise = np.random.default_rng(0).normal(0, 0.1, 1000)
    for disparity, message in (
        (noise, "without a baseline"),
        (5 * noise, "without a baseline"),
        (np.zeros(10), "without a baseline"),
        (noise + 40, "all disparities are 40"),
        (noise - 7, "all disparities are -7"),
        (np.full(5, np.nan), "no disparity was found"),
        (np.empty(0), "no disparity was found"),
    ):
        with pytest.raises(ReconstructionError, match=message) as error:
            check_disparities(disparity)
        one_line(error.value)
    for name in ("art", "cones", "dolls"):
        check_disparities(load_middlebury(shared / "data" / "middlebury" / name).disparity)
    check_disparities(np.append(np.full(90, 7.0), np.full(10, 9.0)))
    check_disparities(np.append(np.full(85, 0.1), np.full(15, 9.0)))


def test_points_behind_the_cameras(one_line) -> None:
    camera = Camera((400, 300), 500.0)
    calibration = Calibration(camera, replace(camera, centre=(229.5, 149.5)), source="c.json")
    disparity = np.linspace(-20, 60, 1000)
    check_depths(disparity, calibration)  # the offset is 30
    with pytest.raises(ReconstructionError, match="100% of the points would lie behind") as error:
        check_depths(-50 - disparity[300:], calibration)
    assert "the disparity offset of 30 px (c.json) is wrong" in one_line(error.value)
    plain = Calibration(camera, camera)
    check_depths(disparity[200:], plain)
    with pytest.raises(ReconstructionError, match="left and right are exchanged"):
        check_depths(-disparity[250:], plain)


def test_what_is_very_far_away_is_not_behind() -> None:
    """Disparities of 0 with noise, as of a sky, are of both signs."""
    camera = Camera((400, 300), 500.0)
    noise = np.random.default_rng(0).normal(0, 0.3, 1000)
    check_depths(np.append(noise, np.full(200, 5.0)), Calibration(camera, camera))
