from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import pytest
from PIL import Image

from deepdetect import DeepDetectError, OptionError
from deepdetect.evaluation import stages
from deepdetect.evaluation.baselines import CLASSICAL
from deepdetect.evaluation.cache import StageCache
from deepdetect.evaluation.workspace import Workspace, image_size, matrix_key

FAST = CLASSICAL["fast"]


@pytest.fixture
def image(tmp_path: Path, photo: np.ndarray) -> Path:
    path = tmp_path / "image.png"
    Image.fromarray(photo[:60, :80]).save(path)
    return path


def opencv_error() -> None:
    cv2.cvtColor(np.zeros((3, 3), np.float64), cv2.COLOR_BGR2HSV)


def network_error() -> None:
    onnxruntime.InferenceSession(b"no network")


def raises(error: Exception):
    def work() -> None:
        raise error

    return work


@pytest.mark.parametrize(
    "work",
    [
        raises(OptionError("reason")),
        raises(DeepDetectError("reason")),
        raises(ValueError("reason")),
        raises(RuntimeError("reason\nmore")),
        raises(ZeroDivisionError()),
        raises(np.linalg.LinAlgError("Singular matrix")),
        raises(TypeError("reason")),
        raises(KeyError("reason")),
        raises(IndexError("reason")),
        raises(AssertionError("reason")),
        raises(ImportError("reason")),
        raises(OSError("reason")),
        raises(MemoryError()),
        opencv_error,
        network_error,
    ],
    ids=[
        *("option", "deepdetect", "value", "runtime", "arithmetic", "linear algebra", "type"),
        *("key", "index", "assertion", "import", "file", "memory", "OpenCV", "ONNX Runtime"),
    ],
)
def test_whatever_a_method_does_wrong_is_left_out_with_its_reason(tmp_path: Path, work) -> None:
    """Methods are anyone's: their networks and functions raise what they like."""
    workspace = Workspace(tmp_path)
    assert workspace.attempt("matches of Mine", work) is None
    (note,) = workspace.left_out
    assert note.startswith("matches of Mine: ")
    assert len(note) > len("matches of Mine: ")
    assert len(note.splitlines()) == 1


def test_a_user_who_stops_it_is_obeyed(tmp_path: Path) -> None:
    def stop() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Workspace(tmp_path).attempt("work", stop)


def test_what_works_is_returned(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path)
    assert workspace.attempt("sum", lambda a, b: a + b, 2, 3) == 5
    assert workspace.left_out == []


def test_a_data_set_is_below_the_folder_or_is_the_folder(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path)
    assert workspace.folder("oxford") == tmp_path
    (tmp_path / "oxford").mkdir()
    assert workspace.folder("oxford") == tmp_path / "oxford"
    assert workspace.folder("hpatches") == tmp_path


def asked(workspace: Workspace, *arguments: object, name: str = "metric 1") -> bool:
    """Ask for a metric; tell whether it had to be made."""
    made = []
    workspace.metric(name, *arguments, lambda: made.append(1) or {"value": np.array(0.5)})
    return bool(made)


def test_a_metric_is_made_anew_when_anything_it_depends_on_changes(
    tmp_path: Path, image: Path, photo: np.ndarray
) -> None:
    other = tmp_path / "other.png"
    Image.fromarray(photo[:60, 90:170]).save(other)
    workspace = Workspace(tmp_path, StageCache(tmp_path / "cache"))
    newer = dataclasses.replace(FAST, version="2")
    renamed = dataclasses.replace(FAST, name="other")
    for _ in range(2):
        calls = [
            asked(workspace, FAST, (image,), {}),
            asked(workspace, FAST, (image,), {"budget": 5}),
            asked(workspace, FAST, (image, other), {}),
            asked(workspace, FAST, (other, image), {}),
            asked(workspace, newer, (image,), {}),
            asked(workspace, renamed, (image,), {}),
            asked(workspace, FAST, (image,), {}, name="metric 2"),
        ]
        assert len(set(calls)) == 1
    assert not any(calls)


def test_a_metric_is_made_anew_when_the_keypoints_are(
    tmp_path: Path, image: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else one table would mix the keypoints of two versions of OpenCV."""
    workspace = Workspace(tmp_path, StageCache(tmp_path / "cache"))
    assert asked(workspace, FAST, (image,), {})
    with monkeypatch.context() as patched:
        patched.setattr(cv2, "__version__", "0.0.0")
        assert asked(workspace, FAST, (image,), {})
    with monkeypatch.context() as patched:
        patched.setattr(stages, "source_digest", lambda: "of other code")
        assert asked(workspace, FAST, (image,), {})


def test_a_matrix_is_known_by_its_numbers() -> None:
    matrix = np.arange(9.0).reshape(3, 3)
    assert matrix_key(matrix) == matrix_key(matrix.T.copy().T)
    assert matrix_key(matrix) == matrix_key(matrix.astype(np.float32))
    moved = matrix.copy()
    moved[0, 2] = np.nextafter(moved[0, 2], 9)
    assert len({matrix_key(m) for m in (matrix, matrix.T, moved)}) == 3


def test_the_size_is_width_and_height(image: Path) -> None:
    assert image_size(image) == (80, 60)
