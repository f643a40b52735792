"""Record how weights and reports were made: command, commit, machine and package versions."""

from __future__ import annotations

import importlib.metadata
import platform
import shlex
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from deepdetect._shared.machine import processor_count, processor_name
from deepdetect._shared.opencv import DISTRIBUTIONS

RUNTIMES = ("onnxruntime", "openvino", "torch")
PACKAGES = ("numpy", *DISTRIBUTIONS, "pillow", *RUNTIMES)


def provenance() -> dict[str, str]:
    """Return command, commit, machine and versions as texts, to store in weights and reports."""
    program, *arguments = sys.argv or [""]
    name = Path(program).name
    command = ["deepdetect" if name == "__main__.py" else name, *arguments]
    return {
        "command": shlex.join(command),
        "commit": _commit(),
        "machine": f"{platform.system()}, {processor_name()}, {processor_count()} processors",
        "versions": ", ".join(_versions()),
    }


def _versions() -> list[str]:
    found = [f"python {platform.python_version()}"]
    for name in ("deepdetect", *PACKAGES):
        with suppress(importlib.metadata.PackageNotFoundError):
            found.append(f"{name} {importlib.metadata.version(name)}")
    return found


def _commit() -> str:
    """Return the git commit of this code, with "+" if source files were modified; "" if unknown."""

    def git(*words: str) -> str:
        command = ["git", "-C", str(Path(__file__).resolve().parent), *words]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    try:
        # This fails if git does not track this file: it may be installed in another project.
        git("ls-files", "--error-unmatch", __file__)
        changed = git("status", "--porcelain", "--", ":/src", ":/lab/src")
        return git("rev-parse", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return ""
