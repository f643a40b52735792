from __future__ import annotations

import importlib.metadata
import json
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from tests.command_line import Result

from deepdetect import DeepDetect
from deepdetect._shared import opencv
from deepdetect.cli import doctor

Run = Callable[..., Result]
ROOT = Path(__file__).parents[2]


@pytest.fixture
def opencv_of(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """Pretend that these packages of OpenCV are installed, and which version is imported."""

    def pretend(version: str | None, modules: tuple[str, ...] = (), **packages: str) -> None:
        module = ModuleType("cv2")
        vars(module).update({"__version__": version, **dict.fromkeys(modules)})
        monkeypatch.setitem(sys.modules, "cv2", module if version else None)
        named = {name.replace("_", "-"): number for name, number in packages.items()}
        for place in (doctor, opencv):
            monkeypatch.setattr(place, "installed_distributions", lambda: list(named))
        real = importlib.metadata.version
        monkeypatch.setattr(
            importlib.metadata, "version", lambda name: named.get(name) or real(name)
        )

    opencv.import_opencv.cache_clear()
    yield pretend
    monkeypatch.undo()
    opencv.import_opencv.cache_clear()


def test_a_working_installation(run: Run) -> None:
    result = run("doctor", "--json")
    report = json.loads(result.stdout)
    assert report["ok"] is True
    assert result.exit_code == 0
    findings = {each["name"]: each["status"] for each in report["findings"]}
    assert "problem" not in findings.values()
    names = ("deepdetect", "numpy", "OpenCV", "back end onnxruntime", "self-test")
    assert [findings[name] for name in names] == ["ok"] * 5


@pytest.mark.parametrize(
    ("imported", "modules", "packages", "status"),
    [
        ("5.0.0", (), {"opencv_python_headless": "5.0.0.93"}, "ok"),
        ("4.13.0", (), {"opencv_python_headless": "5.0.0.93"}, "problem"),
        (
            *("5.0.0", ()),
            {"opencv_python_headless": "5.0.0.93", "opencv_contrib_python_headless": "5.0.0.93"},
            "problem",
        ),
    ],
)
def test_an_opencv_that_hides_another_is_a_problem(
    imported: str, modules: tuple[str, ...], packages: dict[str, str], status: str, opencv_of
) -> None:
    opencv_of(imported, modules, **packages)
    (found,) = doctor.opencv()
    assert found.status == status
    if status == "problem":
        assert found.remedy.endswith(f"--no-deps {[*packages][-1].replace('_', '-')}")


@pytest.mark.slow
def test_the_benchmark_compares_with_sift(run: Run) -> None:
    report = json.loads(run("doctor", "--benchmark", "--json").stdout)
    assert len(report["ratios"]) == 5
    assert set(report["ratios"]) < set(report)
    assert min(report["ratios"].values()) > 0


def test_no_opencv(run: Run, opencv_of, monkeypatch: pytest.MonkeyPatch) -> None:
    opencv_of(None)
    monkeypatch.setattr(doctor, "CHECKS", (doctor.opencv, doctor.packages))
    result = run("doctor")
    assert result.exit_code == 1
    assert "pip install opencv-python-headless" in result.output


def test_packages_that_are_too_old_or_absent(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = [
        "numpy>=2.0",
        "tqdm>=99.1",
        "opencv-python-headless>=4.13",
        'h5py>=3.11 ; extra == "sfm"',
        "no-such-package>=1.17; extra == 'app'",
        "deepdetect[app,sfm]; extra == 'all'",
    ]
    monkeypatch.setattr(importlib.metadata, "requires", lambda name: lines)
    found = {each.name: each for each in doctor.packages()}
    assert found["numpy"].status == "ok"
    assert found["packages"].status == "problem"
    assert found["packages"].remedy == "pip install 'tqdm>=99.1'"
    assert found["app"].value == "no-such-package, for the page in a browser"
    assert not {"all", "train", "sfm"} & {*found}


def test_every_extra_has_a_purpose() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert set(doctor.PURPOSES) == set(project["optional-dependencies"])


def test_the_self_test_knows_wrong_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("openvino", reason="needs OpenVINO")
    from deepdetect.matching import pipeline

    real_heatmap, real_matching = DeepDetect.heatmap, pipeline.match_images

    def heatmap(self: DeepDetect, image: np.ndarray) -> np.ndarray:
        return real_heatmap(self, image) + 0.1 * (self.backend == "openvino")

    def moved(*arguments: object) -> object:
        matches = real_matching(*arguments)
        matches.points1[:] += np.float32(3)
        return matches

    monkeypatch.setattr(DeepDetect, "heatmap", heatmap)
    monkeypatch.setattr(pipeline, "match_images", moved)
    found = {each.name: each.status for each in doctor.self_test()}
    assert found["back end onnxruntime"] == "ok"
    assert found["back end openvino"] == "problem"
    assert found["self-test"] == "problem"


def test_a_check_that_fails_is_a_finding(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def moon() -> None:
        raise RuntimeError("dark side\nsecond line")

    monkeypatch.setattr(doctor, "CHECKS", (moon, doctor.opencv))
    result = run("doctor", "--json")
    assert result.exit_code == 1
    first, second = json.loads(result.stdout)["findings"]
    assert (first["name"], first["remedy"]) == ("moon", "RuntimeError: dark side")
    assert second["status"] == "ok"
