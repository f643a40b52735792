from __future__ import annotations

import platform
import subprocess
import sys

import pytest

from deepdetect._shared.memory import free_memory, keep_freed_memory

ARRAYS = """
import resource
import sys
from deepdetect._shared.memory import keep_freed_memory

def make_and_free():
    for _ in range(20):
        blocks = [bytearray(3_000_000) for _ in range(10)]

if sys.argv[1] == "keep":
    keep_freed_memory()
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


def test_on_another_c_library_nothing_is_done(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "libc_ver", lambda: ("", ""))
    assert not keep_freed_memory()


def test_there_is_memory_but_not_endlessly() -> None:
    assert 0 < free_memory() < 2**50
