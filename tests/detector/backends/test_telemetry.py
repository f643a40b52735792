from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import deepdetect

# What would leave the process or be written into the home folder is printed, and forbidden.
WATCH = """
import os, sys
home, started = os.environ["HOME"], {"os.fork", "os.exec", "os.system", "os.posix_spawn"}
started |= {"subprocess.Popen", "os.startfile", "socket.connect", "socket.getaddrinfo"}
def watch(event, arguments):
    written = event == "os.mkdir" or event == "open" and (arguments[2] or 0) & 3
    if written and isinstance(arguments[0], int):
        return
    if event in started or written and os.fsdecode(arguments[0]).startswith(home):
        print("forbidden:", event, arguments, flush=True)
        raise OSError("forbidden")
sys.addaudithook(watch)
"""
HEATMAP = """
import os, sys
import numpy as np
from deepdetect import DeepDetect
before = dict(os.environ)
DeepDetect(backend=%r).heatmap(np.zeros((40, 48, 3), np.uint8))
assert dict(os.environ) == before
assert sys.modules.get("openvino_telemetry", before) is not None
"""
ONNX_METHOD = """
from deepdetect.detector.pretrained import pretrained_weights
from deepdetect._shared.errors import WeightsError
from deepdetect_lab.evaluation.baselines.external import onnx_feature
try:
    onnx_feature(pretrained_weights())
except WeightsError as error:
    assert "must have the outputs" in str(error), error
"""

needs_openvino = pytest.mark.skipif(
    importlib.util.find_spec("openvino") is None, reason="needs openvino, which is not installed"
)


def run(code: str, home: Path, **variables: str) -> list[str]:
    """Run Python without the settings against telemetry; return what it forbade."""
    kept = {
        name: value
        for name, value in os.environ.items()
        if name not in ("CI", "ORT_DISABLE_TELEMETRY", "XDG_CACHE_HOME")
    }
    source = str(Path(deepdetect.__file__).parents[1])
    done = subprocess.run(
        [sys.executable, "-B", "-c", code],
        env=kept | {"HOME": str(home), "USERPROFILE": str(home), "PYTHONPATH": source} | variables,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    return re.findall("forbidden: (.*)", done.stdout)


@pytest.mark.parametrize(
    "code",
    [
        pytest.param(HEATMAP % "onnxruntime", id="onnxruntime"),
        pytest.param(HEATMAP % "openvino", id="openvino", marks=needs_openvino),
        pytest.param(ONNX_METHOD, id="another network"),
    ],
)
def test_nothing_is_sent_or_left_in_the_home_folder(code: str, tmp_path: Path) -> None:
    assert run(WATCH + code, tmp_path) == []
    assert list(tmp_path.rglob("*")) == []
