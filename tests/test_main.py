"""The program: what ends it before the command line is there to say so."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deepdetect._shared.progress import progress, say, stage_progress
from deepdetect.io.tables import load_keypoints

# Ctrl-C during an import, which a package may turn into another error.
INTERRUPTED_IMPORT = """
import os, signal, time
try:
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(10)
except KeyboardInterrupt:
    {reaction}
"""


@pytest.mark.skipif(os.name != "posix", reason="needs signals")
@pytest.mark.parametrize("reaction", ["raise", "raise ImportError('half imported')"])
@pytest.mark.parametrize(
    ("package", "command"),
    [("cyclopts", "label"), ("cyclopts", "train"), ("numpy", "detect"), ("numpy", "match")],
)
def test_ctrl_c_while_packages_are_imported(
    package: str, command: str, reaction: str, tmp_path: Path
) -> None:
    (tmp_path / f"{package}.py").write_text(INTERRUPTED_IMPORT.format(reaction=reaction))
    arguments = {"match": ["a.png", "b.png"]}.get(command, ["photos", "-o", "out"])
    result = subprocess.run(
        [sys.executable, "-m", "deepdetect", command, *arguments],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])},
        capture_output=True,
        text=True,
        timeout=100,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    assert result.returncode == 130
    assert result.stderr.strip() == "deepdetect: stopped; what was written stays"


@pytest.mark.parametrize(("source", "said"), [("text.mp4", "text"), ("97", "no camera")])
def test_opencv_says_nothing_beside_the_sentence(source: str, said: str, tmp_path: Path) -> None:
    """It writes past Python, so that only another process shows it."""
    (tmp_path / "text.mp4").write_text("I am no video")
    words = [sys.executable, "-m", "deepdetect", "track", source]
    environment = {k: v for k, v in os.environ.items() if not k.startswith("OPENCV_")}
    environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    result = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert result.returncode == 2
    (line,) = result.stderr.splitlines()
    assert said in line


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
@pytest.mark.parametrize("buffered", ["", "1"])
@pytest.mark.parametrize(
    ("streams", "code"),
    [
        (">/dev/full", 2),
        (">/dev/full 2>/dev/full", 2),
        ("2>/dev/full", 0),
        ("2>&-", 0),
        (">&- 2>&- <&-", 0),
        ("--json >/dev/full", 2),
    ],
)
def test_streams_that_cannot_be_written_cost_no_result(
    streams: str, code: int, buffered: str, tmp_path: Path
) -> None:
    Image.fromarray(np.arange(4096, dtype=np.uint8).reshape(64, 64)).save(tmp_path / "a.png")
    words = f"{sys.executable} -m deepdetect detect a.png --max-keypoints 9 -o out {streams}"
    environment = {**os.environ, "PYTHONUNBUFFERED": buffered}
    done = subprocess.run(
        words, shell=True, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True
    )
    assert done.returncode == code, done.stderr
    assert len(load_keypoints(tmp_path / "out/a.npz")) == 9
    assert "Traceback" not in done.stderr
    assert ("cannot write to standard output" in done.stderr) == (code == 2 and "2>" not in streams)


def test_without_standard_error_a_long_task_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    for stream in (None, io.StringIO()):
        monkeypatch.setattr(sys, "stderr", stream)
        if stream is not None:
            stream.close()
        with stage_progress("working", ["one"]) as done, progress(2, "title", "unit") as bar:
            bar.update(2)
            done("one")
        say("done")
