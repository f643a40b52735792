from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from deepdetect.evaluation import metering
from deepdetect.evaluation.metering import StageMeters, metered, peak_memory


def test_the_time_is_that_of_the_block() -> None:
    started = time.perf_counter()
    with metered() as meter:
        time.sleep(0.05)
    assert 0.05 <= meter.seconds <= time.perf_counter() - started
    before = meter.seconds
    time.sleep(0.01)
    assert meter.seconds == before


@pytest.mark.skipif(not metering.STATUS.exists(), reason="the system does not tell its memory")
def test_memory_that_is_freed_within_the_block_counts() -> None:
    with metered() as meter:
        block = np.ones(8_000_000)
        time.sleep(0.1)
        del block
    assert 60e6 < meter.memory < 200e6


@pytest.mark.skipif(not metering.STATUS.exists(), reason="the system does not tell its memory")
def test_what_an_earlier_stage_holds_counts_in_the_whole() -> None:
    meters = StageMeters()
    held = [np.ones(8_000_000)]
    meters.lap("first")
    held.append(np.ones(8_000_000))
    meters.lap("second")
    assert all(60e6 < meter.memory < 100e6 for meter in meters.stages.values())
    assert 120e6 < meters.memory < 180e6
    assert len(held) == 2


@pytest.mark.skipif(not metering.STATUS.exists(), reason="the system does not tell its memory")
def test_a_block_that_takes_nothing_grows_by_little() -> None:
    held = np.ones(8_000_000)
    with metered() as meter:
        time.sleep(0.05)
    assert 0 <= meter.memory < 30e6
    with metered() as meter:
        del held
        time.sleep(0.05)
    assert 0 <= meter.memory < 30e6


def test_an_error_passes_through() -> None:
    with pytest.raises(ValueError, match="inside"), metered() as meter:
        raise ValueError("inside")
    assert meter.seconds > 0


def test_blocks_may_be_nested() -> None:
    with metered() as outer:
        with metered() as inner:
            time.sleep(0.02)
        time.sleep(0.02)
    assert outer.seconds > inner.seconds >= 0.02


def test_the_peak_of_the_process_is_taken_where_the_system_tells_no_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = metering._peak()
    monkeypatch.setattr(metering, "STATUS", Path("/nowhere/status"))
    monkeypatch.setattr(metering, "RESET", Path("/nowhere/clear_refs"))
    with metered() as meter:
        pass
    assert meter.memory >= 0
    assert metering._peak() >= 0.5 * now


@pytest.mark.skipif(not metering.STATUS.exists(), reason="the system does not tell its memory")
def test_the_peak_of_all_outlives_the_reset() -> None:
    block = np.ones(30_000_000)
    before = peak_memory()
    del block
    with metered():
        pass
    assert before > 240e6
    assert peak_memory() == pytest.approx(before, rel=0.02)  # the kernel counts in lumps
