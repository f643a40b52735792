"""The command `deepdetect` in this process, and the pages that show it."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from deepdetect.cli import main


@dataclass(frozen=True)
class Result:
    """How a command ended, and what it printed."""

    exit_code: int
    stdout: str
    stderr: str

    @property
    def output(self) -> str:
        return self.stdout + self.stderr


def run_command(words: Sequence[str]) -> Result:
    """Run `deepdetect` with arguments."""
    stdout, stderr = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(stdout), contextlib.redirect_stderr(stderr):
        code = main(words)
    return Result(code, stdout.getvalue(), stderr.getvalue())


def run_section(
    page: str, heading: str, skipped: Callable[[str], bool] = lambda text: False
) -> int:
    """Run the commands and snippets of a section of a page of docs/, in their order.

    Args:
        page: its name.
        heading: of the section.
        skipped: whether a snippet, or a line with a command, is left out.

    Returns:
        How many have run.
    """
    text = (Path(__file__).parents[1] / "docs" / page).read_text(encoding="utf-8")
    section = text.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    done = 0
    for language, block in re.findall(r"^ *```(sh|python)\n(.*?)^ *```", section, re.S | re.M):
        if language == "python":
            if not skipped(block):
                ran = subprocess.run([sys.executable, "-c", block], capture_output=True, text=True)
                assert ran.returncode == 0, ran.stderr
                done += 1
            continue
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line.partition("#")[0])
            if words[:1] == ["deepdetect"] and not skipped(line):
                result = run_command(words[1:])
                assert result.exit_code == 0, f"{line}\n{result.output}"
                done += 1
    return done
