"""The memory that is free, and what large steps take of it."""

from __future__ import annotations

import ctypes
import os
import platform
from contextlib import suppress
from pathlib import Path

from .errors import OptionError

BYTES_PER = {
    # Descriptors, and the search trees of a matcher.
    "matched_keypoint": 1500,
    # Blending a panorama: a pixel of the canvas, and of the box of one image on it.
    "canvas_pixel": 22,
    "blended_pixel": 25,
    # Five maps of float32, and room for what is made of them.
    "pixel_of_level": 24,
    # Dense matching, at its peak.
    "dense_pixel": 700,
}
"""Measured; `needed_memory` adds them up."""

DEFAULT_MEMORY = 4_000_000_000
"""Bytes assumed where the system does not say."""

# M_MMAP_MAX, M_TRIM_THRESHOLD and M_TOP_PAD of malloc.h: no mappings, no trimming, room for more.
_MALLOPT = ((-4, 0), (-1, -1), (-2, 2**28))
_MMAP_THRESHOLD = (-3, 2**20)  # M_MMAP_THRESHOLD


def available_memory() -> int:
    """Return the bytes that are available without swapping, within the container's limit."""
    return min(_system_memory(), _container_memory())


def needed_memory(**counts: float) -> float:
    """Return the bytes that a step takes; `counts` by the names of `BYTES_PER`."""
    return sum(BYTES_PER[name] * count for name, count in counts.items())


def require_memory(what: str, advice: str, **counts: float) -> None:
    """Refuse a step that would fill the memory; `counts` as of `needed_memory`.

    Raises:
        OptionError: more is needed than is available.
    """
    needed = needed_memory(**counts)
    if needed > available_memory():
        raise OptionError(
            f"{what} need about {needed / 1e9:.2g} GB of memory, more than is free: {advice}"
        )


def disable_malloc_trim() -> None:
    """Let this process keep the memory that it frees, where the C library is glibc.

    By default glibc returns large blocks to the system at once, and each page of the next ones is
    cleared again: a fifth of the time of a training step on the CPU, a sixth of that of labelling.
    """
    if platform.libc_ver()[0] == "glibc":
        for option, value in _MALLOPT:
            ctypes.CDLL(None).mallopt(option, value)


def release_freed_memory() -> None:
    """Return freed memory to the system, now and, in blocks of a megabyte, from now on.

    The C library glibc keeps blocks of up to 32 MB otherwise, of which a network leaves hundreds of
    megabytes. It is a setting of the whole process.
    """
    if platform.libc_ver()[0] == "glibc":
        library = ctypes.CDLL(None)
        library.malloc_trim(0)
        library.mallopt(*_MMAP_THRESHOLD)


def _system_memory() -> int:
    # MemAvailable includes caches that the system can drop.
    with suppress(OSError, StopIteration):  # macOS lacks the file
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvail"))
    with suppress(AttributeError, ValueError):  # Windows
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
    return DEFAULT_MEMORY


def _container_memory() -> int:
    """Return what the control group (version 2) of a container leaves to this process."""
    group = Path("/sys/fs/cgroup")
    with suppress(OSError, ValueError):  # there is none, or its limit is "max"
        limit, used = ((group / f"memory.{name}").read_text() for name in ("max", "current"))
        return max(int(limit) - int(used), 0)
    return 2**62
