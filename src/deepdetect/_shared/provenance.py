"""Provenance of weights and reports: command, versions, commit, machine."""

from __future__ import annotations

import importlib.metadata
import platform
import shlex
import subprocess
import sys
from pathlib import Path

from .opencv import DISTRIBUTIONS
from .parallel import processor_count

PACKAGES = ("numpy", *DISTRIBUTIONS, "pillow", "torch", "lightning-fabric")
"""The packages that results depend on."""


def provenance() -> dict[str, str]:
    """Return what is written into every checkpoint, weights file and report, by name.

    Example:
        >>> sorted(provenance())
        ['command', 'commit', 'machine', 'versions']
    """
    return {
        "command": _command(),
        "commit": _commit(),
        "machine": f"{platform.system()} {platform.machine()}, {processor_count()} processors",
        "versions": ", ".join(_versions()),
    }


def _command() -> str:
    """Return the command line with the program's name."""
    program, *arguments = sys.argv or [""]
    path = Path(program)
    name = "deepdetect" if path.name == "__main__.py" else path.name
    return shlex.join([name, *arguments])


def _versions() -> list[str]:
    found = [f"python {platform.python_version()}"]
    for name in ("deepdetect", *PACKAGES):
        try:
            found.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def _commit() -> str:
    """Return the git commit of the sources, with "+" when files are modified, or ""."""
    sources = Path(__file__).resolve().parents[1]
    run = ["git", "-C", str(sources)]
    try:
        head = subprocess.run(
            [*run, "rev-parse", "HEAD"], capture_output=True, text=True, check=True
        )
        # An installed package may lie in the folder of another project's repository.
        subprocess.run(
            [*run, "ls-files", "--error-unmatch", __file__], capture_output=True, check=True
        )
        changed = subprocess.run(
            [*run, "status", "--porcelain", "--", str(sources)],
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return ""
    return head.stdout.strip() + ("+" if changed.stdout.strip() else "")
