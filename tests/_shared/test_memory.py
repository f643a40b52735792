from __future__ import annotations

import platform
import subprocess
import sys

import pytest

from deepdetect._shared import memory
from deepdetect._shared.errors import OptionError
from deepdetect._shared.memory import available_memory, require_memory

ARRAYS = """
import resource
import sys
from deepdetect._shared.memory import disable_malloc_trim

def make_and_free():
    for _ in range(20):
        blocks = [bytearray(3_000_000) for _ in range(10)]

if sys.argv[1] == "keep":
    disable_malloc_trim()
make_and_free()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
make_and_free()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def page_faults(mode: str) -> int:
    done = subprocess.run(
        [sys.executable, "-c", ARRAYS, mode], check=True, capture_output=True, text=True
    )
    return int(done.stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_freed_memory_is_used_again_without_new_pages() -> None:
    assert page_faults("keep") < 0.1 * page_faults("give")


def test_there_is_memory_but_not_endlessly() -> None:
    assert 0 < available_memory() < 2**50


def test_a_step_that_does_not_fit_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available_memory", lambda: 1.5e9)
    require_memory("a million keypoints", "take fewer", matched_keypoint=1e6)
    with pytest.raises(OptionError, match=r"need about 1.6 GB .*, more than is free: take"):
        require_memory("many keypoints", "take fewer", matched_keypoint=1.1e6)
