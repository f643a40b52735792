"""What the package does without its extras, and with any OpenCV, and what it says of the others."""

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
NO_NUMBA = "sys.modules['numba'] = None"
NO_OPENCV = "sys.modules['cv2'] = None"
NO_CONTRIB = """
import cv2
cv2.xfeatures2d = None
for name in ("AgastFeatureDetector_create", "BRISK_create"):
    if hasattr(cv2, name):
        delattr(cv2, name)
"""
NOTHING_MORE = "for name in ('matplotlib', 'psutil', 'scipy', 'torch'): sys.modules[name] = None"
MATCH = 'pip install "deepdetect[match]"'

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
        "detect left.png --max-keypoints 50 --spread anms",
        "match left.png right.png --unguided --max-keypoints 200",
        "match left.png right.png --unguided --density .1 --descriptor rootsift",
        "match left.png right.png --unguided --threshold .9 --matcher auto",
    ],
)
def test_what_needs_no_extra(run: Run, command: str) -> None:
    assert run("\n".join((NO_NUMBA, NO_CONTRIB, NOTHING_MORE)), *command.split())[0] == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "task"),
    [
        ("match left.png right.png", "guided matching"),
        ("match left.png right.png --unguided --matcher patchmatch", "the matcher patchmatch"),
        ("register left.png right.png", "registration"),
        ("stitch left.png right.png", "stitching"),
        ("reconstruct left.png right.png --focal 300", "reconstruction"),
    ],
)
def test_what_needs_numba_says_so_in_one_sentence(run: Run, command: str, task: str) -> None:
    code, said = run(f"{NO_NUMBA}\n{NOTHING_MORE}", *command.split())
    assert code == 2
    assert said.startswith(f"deepdetect: {task} needs numba, which is not installed: run `{MATCH}`")
    assert said.count("\n") == 1
    assert ("--unguided" in said) == (task == "guided matching")


@pytest.mark.slow
def test_points_and_descriptors_are_the_same_without_numba() -> None:
    code = """
import json, sys
{before}
import cv2
import numpy as np
from deepdetect import DeepDetect, match_images
rng = np.random.default_rng(0)
image = cv2.GaussianBlur(rng.integers(0, 256, (400, 520, 3), np.uint8), (0, 0), 1)
image = cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX)
detector = DeepDetect(backend="onnxruntime")
found = [detector.detect(image, max_keypoints=600, spread=how) for how in ("none", "anms")]
pair = match_images(image[:, 20:], image, detector, guided=False, max_keypoints=300,
                    descriptor="rootsift")
numbers = [p for f in found for p in (f.xy, f.angles, f.scores)] + [pair.points0, pair.points1]
print(json.dumps([np.asarray(part, float).tolist() for part in numbers]))
"""
    with_numba, without = (
        in_a_fresh_interpreter(code.replace("{before}", before)) for before in ("", NO_NUMBA)
    )
    assert with_numba == without


@pytest.mark.slow
@pytest.mark.parametrize("command", ["detect left.png", "label left.png -o labels"])
def test_no_opencv_is_one_sentence(run: Run, command: str) -> None:
    code, said = run(NO_OPENCV, *command.split())
    assert code == 2
    assert said.splitlines()[-1].startswith("deepdetect: OpenCV is not installed: ")
    assert 'pip install "deepdetect[opencv]"' in said
    assert "Traceback" not in said


@pytest.mark.slow
def test_labels_without_contrib_are_one_sentence(run: Run) -> None:
    code, said = run(NO_CONTRIB, *["label", "left.png", "-o", "labels", "--detectors", "agast"])
    assert code == 2
    assert said.splitlines()[-1].startswith("deepdetect: AGAST needs OpenCV's contrib modules, ")
    assert "opencv-contrib-python-headless" in said
    rest = "label left.png -o labels --detectors sift,orb,fast,harris,shi-tomasi,canny,sobel"
    assert run(NO_CONTRIB, *rest.split())[0] == 0
