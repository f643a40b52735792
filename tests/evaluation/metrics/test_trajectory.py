from __future__ import annotations

import numpy as np
import pytest

from deepdetect import OptionError
from deepdetect.evaluation.metrics.trajectory import trajectory_errors


def turn(degrees: float) -> np.ndarray:
    angle = np.radians(degrees)
    return np.array(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    )


PATH = np.column_stack([np.zeros(61), np.zeros(61), np.arange(61.0)])
STRAIGHT = np.stack([np.eye(3)] * 61)


def test_frame_and_scale_do_not_count() -> None:
    """The same path in another frame, and half as long, has no error."""
    away = turn(30)
    errors = trajectory_errors(away @ STRAIGHT, 0.5 * PATH @ away.T + 7, STRAIGHT, PATH)
    assert errors.scale == pytest.approx(2)
    assert errors.length == pytest.approx(60)
    for name in ("end_percent", "mean_percent", "end_deg_per_m", "segment_percent"):
        assert getattr(errors, name) == pytest.approx(0, abs=1e-9), name
    np.testing.assert_allclose(errors.centres, PATH, atol=1e-9)


def test_known_errors() -> None:
    """A camera that turns by .01 degrees in each metre without moving aside."""
    turning = np.stack([turn(0.01 * k) for k in range(61)])
    errors = trajectory_errors(turning, PATH, STRAIGHT, PATH)
    assert errors.end_deg_per_m == pytest.approx(0.01)
    assert errors.segment_deg_per_m == pytest.approx(0.01)
    assert errors.end_percent == pytest.approx(0)
    # Seen from the turned camera the same motion goes aside: half of what it turns before, at most.
    assert errors.segment_percent == pytest.approx(100 * np.radians(0.01 * 13), rel=0.5)
    aside = PATH + [[0.6, 0, 0]] * (np.arange(61) == 60)[:, None]
    assert trajectory_errors(STRAIGHT, aside, STRAIGHT, PATH).end_percent == pytest.approx(
        1, abs=0.01
    )


def test_drift_of_scale_is_an_error() -> None:
    drifting = PATH * np.linspace(1, 1.1, 61)[:, None]
    errors = trajectory_errors(STRAIGHT, drifting, STRAIGHT, PATH)
    assert errors.end_percent > 1
    assert errors.segment_percent > 2


def test_the_wrong_way_is_an_error() -> None:
    errors = trajectory_errors(STRAIGHT, -PATH, STRAIGHT, PATH)
    assert errors.scale == 0
    assert errors.end_percent == pytest.approx(100)


def test_short_paths_have_no_segments() -> None:
    errors = trajectory_errors(STRAIGHT[:5], PATH[:5], STRAIGHT[:5], PATH[:5])
    assert np.isnan(errors.segment_percent)


def test_what_cannot_be_compared() -> None:
    for path, true in ((PATH[:3], PATH), (PATH[:1], PATH[:1]), (0 * PATH, PATH)):
        with pytest.raises(OptionError):
            trajectory_errors(STRAIGHT[: len(path)], path, STRAIGHT[: len(true)], true)
