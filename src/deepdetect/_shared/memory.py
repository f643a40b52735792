"""How much memory this process may still take, and whether it gives it back."""

from __future__ import annotations

import ctypes
import os
import platform
from pathlib import Path

UNKNOWN = 4_000_000_000
"""Bytes assumed where the system does not tell."""

# Of malloc.h: no block of its own mapping, nothing given back at the end, room for more.
_KEEP = ((-4, 0), (-1, -1), (-2, 2**28))


def free_memory() -> int:
    """Return the memory in bytes that can be had without swapping, within the container's limit.

    Example:
        >>> free_memory() > 0
        True
    """
    return min(_system_memory(), _container_memory())


def keep_freed_memory() -> bool:
    """Let this process keep what it frees, for its next arrays, as far as the system can do that.

    The GNU library gives large blocks back at once, and the system clears each page of the
    next ones anew: a training step on the CPU, which makes and frees gigabytes, spends a fifth
    of its time on that. It holds for the whole process, whose memory stays at its peak.

    Returns:
        Whether it will be so.

    Example:
        >>> keep_freed_memory() in (True, False)
        True
    """
    if platform.libc_ver()[0] != "glibc":
        return False
    mallopt = ctypes.CDLL(None).mallopt
    return all(mallopt(option, value) for option, value in _KEEP)


def _system_memory() -> int:
    try:
        # MemAvailable counts the caches that the system would give up; macOS lacks the file.
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except (OSError, ValueError, IndexError):
        pass
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
    except (AttributeError, ValueError, OSError):
        return UNKNOWN


def _container_memory() -> int:
    """Return what a control group (version 2) leaves to this process."""
    group = Path("/sys/fs/cgroup")
    try:
        limit = (group / "memory.max").read_text().strip()
        used = int((group / "memory.current").read_text())
        return 2**62 if limit == "max" else max(int(limit) - used, 0)
    except (OSError, ValueError):
        return 2**62
