from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
import urllib.request
from pathlib import Path

import pytest
from tests.command_line import run_command

from deepdetect.app.jobs import AppOptions
from deepdetect.app.server import AppServer


def started(temporary: Path) -> tuple[subprocess.Popen[str], str]:
    """Start the program, and wait until it has said its address."""
    process = subprocess.Popen(
        [sys.executable, "-m", "deepdetect", "app", "--port", "0"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(temporary)},
    )
    assert process.stdout is not None
    line = process.stdout.readline()
    found = re.fullmatch(r"DeepDetect is at (http://127\.0\.0\.1:\d+/)#key=\S{32}\n", line)
    assert found, line
    return process, found[1]


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize("signal_name", ["SIGINT", "SIGHUP"])  # SIGHUP becomes SIGTERM
def test_a_signal_ends_it_without_a_trace(signal_name: str, tmp_path: Path) -> None:
    if signal.getsignal(getattr(signal, signal_name)) == signal.SIG_IGN:
        pytest.skip("whoever started the tests ignores it, as nohup does")
    process, address = started(tmp_path)
    with urllib.request.urlopen(address) as page:
        assert b"<title>DeepDetect" in page.read()
    assert list(tmp_path.iterdir())
    process.send_signal(getattr(signal, signal_name))
    said = process.communicate(timeout=60)[1]
    assert process.returncode == 0
    assert said.splitlines() == ["Ctrl+C ends it.", "deepdetect: ended; nothing was kept"]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_what_a_killed_server_left_is_removed_at_the_next_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    process, _ = started(tmp_path)
    (left,) = tmp_path.iterdir()
    (left / "photograph.jpg").write_bytes(b"x")
    process.kill()
    process.communicate(timeout=60)
    assert left.is_dir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with AppServer(AppOptions(port=0)):
        (now,) = tmp_path.iterdir()
        assert now != left


def test_a_port_out_of_range() -> None:
    assert run_command(["app", "--port", "70000"]).exit_code == 2
