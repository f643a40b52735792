from __future__ import annotations

import math
import mmap
import os
import time

import numpy as np
import pytest

from deepdetect import DeepDetectError
from deepdetect_lab.evaluation.profiling import peak_memory, profiled, run_in_child


def written(size_bytes: int) -> mmap.mmap:
    """Take memory from the system: an array may get some that was freed before."""
    block = mmap.mmap(-1, size_bytes)
    np.frombuffer(block, np.uint8)[:] = 1
    return block


def test_memory_that_is_freed_within_the_block_counts() -> None:
    with profiled() as profile:
        block = written(128_000_000)
        time.sleep(0.1)
        block.close()
    assert 120e6 < profile.memory < 300e6


def _leave() -> None:
    os._exit(1)


def test_a_child_tells_its_own_memory_not_that_of_its_parent() -> None:
    held = np.ones(30_000_000)  # 240 MB
    assert peak_memory() > held.nbytes
    assert 1e6 < run_in_child(peak_memory) < held.nbytes


def test_a_child_that_is_ended_is_one_sentence() -> None:
    with pytest.raises(DeepDetectError):
        run_in_child(_leave)
    with pytest.raises(ValueError, match="math domain"):
        run_in_child(math.sqrt, -1)
