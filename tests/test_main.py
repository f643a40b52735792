"""The program: what ends it before the command line is there to say so."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

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


@pytest.mark.parametrize(("source", "said"), [("text.mp4", "no video"), ("97", "no camera")])
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
