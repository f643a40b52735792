"""What a plain installation does, and what it says where a package is missing."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import deepdetect

ROOT = Path(deepdetect.__path__[0])
NO_OPENCV = "sys.modules['cv2'] = None"
NO_CONTRIB = """
import cv2
cv2.xfeatures2d = None
for name in ("AgastFeatureDetector_create", "BRISK_create"):
    if hasattr(cv2, name):
        delattr(cv2, name)
"""
NOTHING_MORE = "for name in ('matplotlib', 'scipy', 'torch'): sys.modules[name] = None"

Run = Callable[..., tuple[int, str]]


@pytest.fixture
def run(tmp_path: Path, photo: np.ndarray) -> Run:
    """Run a command line after some Python, and return its exit code and its errors."""
    from PIL import Image

    Image.fromarray(photo).save(tmp_path / "left.png")
    Image.fromarray(np.ascontiguousarray(photo[:, 8:])).save(tmp_path / "right.png")

    def do(before: str, *arguments: str) -> tuple[int, str]:
        code = f"import sys\n{before}\nfrom deepdetect.__main__ import main\nmain()"
        done = subprocess.run(
            [sys.executable, "-c", code, *arguments],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        return done.returncode, done.stderr

    return do


def in_a_fresh_interpreter(code: str) -> object:
    """Run code that prints JSON."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def test_a_detector_is_ready_without_opencv() -> None:
    code = """
import json, sys
from deepdetect import DeepDetect
DeepDetect(backend="onnxruntime")
print(json.dumps(sorted(sys.modules)))
"""
    loaded = in_a_fresh_interpreter(code)
    # What is imported is what the time and the memory go into.
    assert not {"cv2", "numba", "PIL", "numpy.random", "multiprocessing", "tqdm"} & {*loaded}


def test_commands_and_matching_import_opencv_when_they_use_it() -> None:
    code = """
import json, sys
from deepdetect.cli import demo, detect, export, features, match, reconstruct
from deepdetect import matching, reconstruction, sfm
print(json.dumps(sorted(sys.modules)))
"""
    assert "cv2" not in in_a_fresh_interpreter(code)


def test_no_module_imports_opencv_itself() -> None:
    for path in ROOT.rglob("*.py"):
        if path.name != "opencv.py" or path.parent.name != "_shared":
            lines = path.read_text("utf-8").splitlines()
            assert not any(line.lstrip().startswith(("import cv2", "from cv2")) for line in lines)


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [
        "detect left.png",
        "detect left.png --max-keypoints 50",
        "detect left.png --detector points --max-keypoints 50 --spread anms",
        "match left.png right.png",
        "match left.png right.png --unguided --max-keypoints 200",
        "register left.png right.png",
        "stitch left.png right.png",
    ],
)
def test_what_needs_no_extra(run: Run, command: str) -> None:
    assert run("\n".join((NO_CONTRIB, NOTHING_MORE)), *command.split())[0] == 0


@pytest.mark.slow
@pytest.mark.parametrize("command", ["detect left.png", "label left.png -o labels"])
def test_without_opencv_nothing_is_written(run: Run, command: str, tmp_path: Path) -> None:
    code, said = run(NO_OPENCV, *command.split())
    assert code == 2
    assert said.splitlines()[-1].startswith("deepdetect: OpenCV cannot be imported (")
    assert "run pip install opencv-python-headless" in said
    assert "Traceback" not in said
    assert sorted(path.name for path in tmp_path.rglob("*.*")) == ["left.png", "right.png"]


@pytest.mark.slow
def test_labels_without_contrib_are_one_sentence(run: Run) -> None:
    code, said = run(NO_CONTRIB, *["label", "left.png", "-o", "labels", "--detectors", "agast"])
    assert code == 2
    assert said.splitlines()[-1].startswith("deepdetect: AGAST needs OpenCV's contrib modules, ")
    assert "opencv-contrib-python-headless" in said
    rest = "label left.png -o labels --detectors sift,orb,fast,harris,shi-tomasi,canny,sobel"
    assert run(NO_CONTRIB, *rest.split())[0] == 0
