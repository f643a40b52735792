from __future__ import annotations

import importlib.metadata
import json
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from click.testing import Result

import deepdetect
from deepdetect._shared import opencv
from deepdetect.cli import _installation_checks as checks
from deepdetect.cli._findings import findings_of
from deepdetect.cli._self_test import SHIFT_PX, run_self_test

Run = Callable[..., Result]
ROOT = Path(__file__).parents[2]


@pytest.fixture
def fresh_opencv(monkeypatch: pytest.MonkeyPatch) -> None:
    opencv.import_opencv.cache_clear()
    yield
    monkeypatch.undo()
    opencv.import_opencv.cache_clear()


def with_packages(monkeypatch: pytest.MonkeyPatch, **versions: str) -> None:
    """Pretend that these packages of OpenCV are installed, and no others."""
    named = {name.replace("_", "-"): version for name, version in versions.items()}
    monkeypatch.setattr(opencv, "installed_distributions", lambda: list(named))
    real = importlib.metadata.version
    monkeypatch.setattr(
        importlib.metadata, "version", lambda name: named[name] if name in named else real(name)
    )


def find(result: Result, name: str) -> dict:
    found = [each for each in json.loads(result.stdout)["findings"] if each["name"] == name]
    assert len(found) == 1, result.stdout
    return found[0]


def test_a_working_installation(run: Run) -> None:
    pytest.importorskip("numba", reason="needs numba for guided matching")
    result = run("doctor", "--json")
    found = json.loads(result.stdout)
    problems = [each for each in found["findings"] if each["status"] == "problem"]
    assert problems == []
    assert found["ok"] is True
    assert result.exit_code == 0
    assert find(result, "deepdetect")["details"]["version"] == deepdetect.__version__
    answer = find(result, "self-test")["details"]
    assert answer["precision"] > 0.99
    assert answer["guided"] is True
    assert set(answer["seconds"]) == {
        "load the network",
        "dense keypoints",
        "256 points",
        "guided matching, the first time",
        "guided matching",
    }
    backends = {each["name"] for each in found["findings"] if each["name"].startswith("back end ")}
    assert {"back end onnxruntime", "back end in use"} <= backends
    assert find(result, "this folder")["details"]["free_bytes"] > 0


def test_the_table_says_what_to_do(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    with_packages(monkeypatch, opencv_python="4.12.0.88", opencv_contrib_python="4.11.0.1")
    result = run("doctor", "--no-self-test")
    assert result.exit_code == 1
    assert "PROBLEM: 2 packages have written into one folder" in result.output
    told = result.output.partition("what to do\n")[2]
    assert "pip uninstall -y opencv-python opencv-contrib-python" in told
    assert "pip install opencv-contrib-python." in told
    assert "self-test" not in result.output


def test_no_opencv(run: Run, monkeypatch: pytest.MonkeyPatch, fresh_opencv: None) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with_packages(monkeypatch)
    result = run("doctor", "--json", "--no-self-test")
    assert result.exit_code == 1
    found = find(result, "OpenCV")
    assert found["status"] == "problem"
    assert found["remedy"].startswith("OpenCV is not installed: ")
    lacking = find(result, "extra opencv")
    assert lacking["status"] == "missing"
    assert lacking["details"]["lacking"] == ["opencv-python-headless"]


def test_an_opencv_that_another_one_has_overwritten(
    run: Run, monkeypatch: pytest.MonkeyPatch, fresh_opencv: None
) -> None:
    other = ModuleType("cv2")
    vars(other).update(__version__="4.11.0", __file__="elsewhere/cv2/__init__.py")
    monkeypatch.setitem(sys.modules, "cv2", other)
    with_packages(monkeypatch, opencv_python_headless="4.12.0.88")
    found = find(run("doctor", "--json", "--no-self-test"), "OpenCV")
    assert found["status"] == "problem"
    assert found["value"] == "4.11.0 is imported, though opencv-python-headless 4.12.0.88 is " + (
        "installed"
    )
    assert "elsewhere/cv2/__init__.py" in found["remedy"]


def test_contrib_modules_are_said(monkeypatch: pytest.MonkeyPatch, fresh_opencv: None) -> None:
    other = ModuleType("cv2")
    vars(other).update(__version__="5.0.0", __file__="cv2.so")
    monkeypatch.setitem(sys.modules, "cv2", other)
    with_packages(monkeypatch, opencv_python_headless="5.0.0.93")
    (found,) = findings_of(checks.check_opencv)
    assert found.status == "ok"
    assert found.details["labels"] is False
    assert "without the contrib modules" in found.value
    rows = {each.name: each for each in findings_of(checks.check_extras)}
    assert rows["extra labels"].details["install"] == (  # never two of them
        'pip uninstall -y opencv-python-headless, then pip install "deepdetect[labels]"'
    )


def test_a_backend_that_cannot_be_loaded(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from deepdetect.detector import pretrained

    for name in ("default", "dense"):
        for suffix in (".onnx", ".safetensors"):
            (tmp_path / f"{name}{suffix}").write_bytes(b"not weights")
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path)
    result = run("doctor", "--json")
    assert result.exit_code == 1
    found = find(result, "back end onnxruntime")
    assert (found["status"], found["value"]) == ("problem", "does not run")
    assert "default.onnx" in found["remedy"]
    assert find(result, "self-test")["status"] == "problem"


def test_a_backend_of_other_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    from deepdetect.detector.backends import registry

    monkeypatch.setattr(checks.importlib.util, "find_spec", lambda name: name != "torch" or None)
    for name in ("onnxruntime", "openvino"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))

    def open_network(path: Path, options: object) -> tuple[object, str]:
        answer = 1.0 if options.backend == "openvino" else 0.0
        return lambda image: np.full((1, 1, *image.shape[2:]), answer, np.float32), ""

    monkeypatch.setattr(registry, "open_network", open_network)
    found = {each.name: each for each in findings_of(checks.check_backends)}
    assert found["back end openvino"].status == "problem"
    assert "differ from the others' by up to 0.23" in found["back end openvino"].value
    assert found["back end in use"].value == "onnxruntime"


@pytest.mark.parametrize("there", [True, False])
def test_whether_bfloat16_can_be_chosen(
    there: bool, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    openvino = pytest.importorskip("openvino", reason="needs OpenVINO")
    real = openvino.Core.get_property

    def of_processor(core: object, device: str, name: str) -> object:
        if name == "OPTIMIZATION_CAPABILITIES":
            return ["FP32", *(["BF16"] if there else [])]
        return real(core, device, name)

    monkeypatch.setattr(openvino.Core, "get_property", of_processor)
    found = find(run("doctor", "--json", "--no-self-test"), "bfloat16")
    assert found["status"] == "ok"
    assert found["details"]["available"] is there
    said = "computes it" if there else "--precision bfloat16 is refused"
    assert said in found["value"]


def test_weights_that_are_gone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from deepdetect.detector import pretrained

    monkeypatch.setattr(pretrained, "FOLDER", tmp_path)
    (found,) = findings_of(checks.check_weights)
    assert found.status == "problem"
    assert found.details["absent"] == [
        f"{name}{suffix}"
        for name in ("default", "dense", "free")
        for suffix in (".onnx", ".safetensors")
    ]


def test_a_folder_that_cannot_be_written(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def refuse(dir: Path) -> None:
        if Path(dir) == tmp_path:
            raise PermissionError(13, "Permission denied")
        raise OSError(28, "No space left on device")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(checks.tempfile, "TemporaryFile", refuse)
    here, temporary = findings_of(checks.check_folders)
    assert (here.status, temporary.status) == ("warning", "warning")
    assert "cannot be written (Permission denied)" in here.value
    assert temporary.remedy == "Set TMPDIR to a folder that can be written."
    assert here.details["writable"] is False


def test_no_cache_for_compiled_code(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("numba", reason="needs numba")
    from deepdetect.features import suppression_kernel

    class Uncached:
        stats = type("Stats", (), {"cache_path": None})

    monkeypatch.setattr(suppression_kernel, "keep_distant", Uncached)
    (found,) = findings_of(checks.check_compiler)
    assert found.status == "warning"
    assert "NUMBA_CACHE_DIR" in found.remedy


def test_threads_and_a_limit_of_a_container(monkeypatch: pytest.MonkeyPatch) -> None:
    from deepdetect._shared import parallel

    monkeypatch.setattr(parallel, "processor_count", lambda: 8)
    monkeypatch.setattr(checks, "_processor_quota", lambda: 2.5)
    monkeypatch.setenv("OMP_NUM_THREADS", "4")
    processors, memory = findings_of(checks.check_processors)
    assert processors.status == "warning"
    assert processors.remedy.startswith("Give --threads 2: ")
    assert processors.details["variables"]["OMP_NUM_THREADS"] == "4"
    assert memory.details["available_bytes"] > 0


def test_packages_that_are_too_old_or_absent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        importlib.metadata,
        "requires",
        lambda name: [
            "numpy>=2.0",
            'h5py>=3.11 ; extra == "hdf5"',
            "faiss-cpu>=1.9; extra == 'faiss'",
            "onnx>=1.17; extra == 'onnx'",
            "torch>=2.5; extra == 'train'",
        ],
    )
    versions = {"h5py": "3.9.0", "onnx": "1.17"}
    monkeypatch.setattr(checks, "_version", versions.get)
    found = {each.details["extra"]: each for each in findings_of(checks.check_extras)}
    assert found["hdf5"].details["lacking"] == ["h5py 3.11 or later (not 3.9.0)"]
    assert found["faiss"].details["lacking"] == ["faiss-cpu"]
    assert found["faiss"].details["install"] == 'pip install "deepdetect[faiss]"'
    assert found["onnx"].status == "ok"
    assert "https://download.pytorch.org/whl/cpu" in found["train"].details["install"]


def test_every_extra_has_a_purpose() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert set(checks.PURPOSES) == set(project["optional-dependencies"])


@pytest.mark.parametrize(
    ("moved_by", "status"), [((6, 4), "ok"), ((9, 4), "problem"), ((0, 0), "problem")]
)
def test_the_self_test_knows_a_wrong_answer(
    monkeypatch: pytest.MonkeyPatch, moved_by: tuple[int, int], status: str
) -> None:
    """Its answer is compared with the true shift: with another truth the same matches are wrong."""
    pytest.importorskip("numba", reason="needs numba for guided matching")
    right = SHIFT_PX
    from deepdetect.matching import pipeline

    real = pipeline.match_images

    def moved(a: np.ndarray, b: np.ndarray, *arguments: object, **options: object) -> object:
        matches = real(a, b, *arguments, **options)
        matches.points1[:] += np.subtract(right, moved_by).astype(np.float32)
        return matches

    monkeypatch.setattr(pipeline, "match_images", moved)
    found, *_ = findings_of(run_self_test)
    assert found.status == status


def test_a_check_that_fails_is_a_finding(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def check_moon() -> None:
        raise RuntimeError("dark side\nsecond line")

    monkeypatch.setattr(checks, "CHECKS", (check_moon, checks.check_package))
    result = run("doctor", "--json", "--no-self-test")
    assert result.exit_code == 1
    found = find(result, "moon")
    assert found["remedy"] == "RuntimeError: dark side."
    assert find(result, "Python")["status"] == "ok"
