from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

from click.testing import CliRunner

from deepdetect.cli import main


def test_it_prints_its_address_and_ends_without_a_trace(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "deepdetect", "app", "--port", "0"]
    started = subprocess.Popen(
        words,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(tmp_path)},
    )
    assert started.stdout is not None
    line = started.stdout.readline()
    found = re.fullmatch(r"DeepDetect is at (http://127\.0\.0\.1:\d+/)#key=\S{32}\n", line)
    assert found, line
    with urllib.request.urlopen(found[1]) as page:
        assert b"<title>DeepDetect" in page.read()
    assert list(tmp_path.iterdir())
    started.send_signal(signal.SIGINT)
    said = started.communicate(timeout=60)[1]
    assert started.returncode == 0
    assert said.splitlines() == ["Ctrl+C ends it.", "deepdetect: ended; nothing was kept"]
    assert list(tmp_path.iterdir()) == []


def test_a_port_out_of_range() -> None:
    result = CliRunner().invoke(main, ["app", "--port", "70000"])
    assert result.exit_code == 2
    assert result.output == "deepdetect: --port must lie in [0, 65535], not 70000\n"
