"""The C++ example is built, and finds the keypoints that the package finds."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial import cKDTree

from deepdetect import DeepDetect, PointDetector
from deepdetect.detector.pretrained import pretrained_weights

FOLDER = Path(__file__).parents[2] / "examples/onnx_cpp"


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built example."""
    onnxruntime = Path(os.environ.get("ONNXRUNTIME", Path(sys.prefix) / "onnxruntime")).absolute()
    if not (onnxruntime / "include/onnxruntime_cxx_api.h").is_file():
        pytest.skip(f"needs the headers of ONNX Runtime in {onnxruntime}: run make onnxruntime")
    if shutil.which("make") is None or shutil.which("g++") is None:
        pytest.skip("needs make and g++")
    build = tmp_path_factory.mktemp("build")
    words = ["make", "-C", str(FOLDER), f"ONNXRUNTIME={onnxruntime}", f"BUILD={build}"]
    made = subprocess.run([*words, "CXXFLAGS=-O1 -Wall -Wextra -Werror"], capture_output=True)
    assert made.returncode == 0, made.stderr.decode()
    return build / "keypoints"


@pytest.mark.slow
def test_the_keypoints_are_those_of_the_package(
    program: Path, photo: np.ndarray, tmp_path: Path
) -> None:
    rgb = photo[:123, :157]
    Image.fromarray(rgb).save(tmp_path / "photo.ppm")
    words = [str(program), str(pretrained_weights()), str(tmp_path / "photo.ppm"), "0.5"]
    printed = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    found = np.array([line.split() for line in printed.splitlines()], float)
    expected = DeepDetect(backend="onnxruntime").detect(rgb)
    assert len(expected) > 1000
    np.testing.assert_array_equal(found[:, :2], expected.xy)
    np.testing.assert_allclose(found[:, 2], expected.scores, atol=1e-4)
    words[-1] = "0.9"
    fewer = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    assert len(fewer.splitlines()) == np.sum(found[:, 2] > 0.9)


@pytest.mark.slow
def test_the_points_are_those_of_the_package(
    program: Path, photo: np.ndarray, tmp_path: Path
) -> None:
    pytest.importorskip("onnx", reason="needs onnx, which is for exporting only")
    from deepdetect.detector.onnx_files.export import OnnxOptions, write_onnx

    write_onnx("default", tmp_path / "points.onnx", OnnxOptions(maps=False))
    Image.fromarray(photo).save(tmp_path / "photo.ppm")
    words = [str(program), str(tmp_path / "points.onnx"), str(tmp_path / "photo.ppm")]
    printed = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    found = np.array([line.split() for line in printed.splitlines()], float)
    expected = PointDetector(2048).detect(photo)
    assert found.shape == (len(expected), 5)
    places = np.column_stack([expected.xy, expected.sizes])
    gaps, nearest = cKDTree(found[:, :3]).query(places)
    assert (gaps < 0.05).mean() > 0.98
    assert np.median(np.abs(found[nearest, 4] - expected.scores)) < 1e-4
    assert np.median(np.abs(found[nearest, 3] - expected.angles)) < 0.01
