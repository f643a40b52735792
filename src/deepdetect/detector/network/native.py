"""C++ of this package, compiled for this processor when it is first wanted."""

from __future__ import annotations

import ctypes
import functools
import shutil
import subprocess
import tempfile
from pathlib import Path

# With g++ OpenMP is that of torch, which is loaded already: its threads do the work.
FLAGS = "-O3 -march=native -fno-math-errno -fno-trapping-math -fopenmp -fPIC -shared"


@functools.cache
def native_library(name: str) -> ctypes.CDLL | None:
    """Compile and load a C++ file of this folder.

    Args:
        name: the file's name without its ending.

    Returns:
        The library, or None where there is no compiler that can do it.

    Example:
        >>> native_library("no such file") is None
        True
    """
    compiler = shutil.which("g++")
    source = Path(__file__).with_name(f"{name}.cpp")
    if compiler is None or not source.exists():
        return None
    try:
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            library = Path(folder) / f"{name}.so"
            subprocess.run(
                [compiler, *FLAGS.split(), "-o", library, source], check=True, capture_output=True
            )
            return ctypes.CDLL(str(library))
    except (OSError, subprocess.CalledProcessError):
        return None
