"""The JavaScript example finds the keypoints that the package finds."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial import cKDTree

from deepdetect import DeepDetect, PointDetector
from deepdetect.detector.pretrained import pretrained_weights

FOLDER = Path(__file__).parents[2] / "examples/onnx_js"
NO_NETWORK = ("ENOTFOUND", "EAI_AGAIN", "ECONNREFUSED", "ETIMEDOUT", "ENETUNREACH")


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the example with the packages of its lock file."""
    if shutil.which("npm") is None or shutil.which("node") is None:
        pytest.skip("needs node and npm")
    folder = tmp_path_factory.mktemp("npm") / "example"
    shutil.copytree(FOLDER, folder, ignore=shutil.ignore_patterns("node_modules"))
    words = ["npm", "ci", "--ignore-scripts", "--no-audit", "--no-fund"]
    made = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    if any(word in made.stderr for word in NO_NETWORK):
        pytest.skip("needs npm's registry, which cannot be reached")
    assert made.returncode == 0, made.stderr
    return folder


def run_example(folder: Path, *words: object) -> np.ndarray:
    command = ["node", "keypoints.mjs", *map(str, words)]
    ended = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    return np.array([line.split() for line in ended.stdout.splitlines()], float)


@pytest.mark.slow
@pytest.mark.parametrize(("height", "width"), [(123, 157), (64, 96), (17, 23), (200, 41), (96, 99)])
def test_the_keypoints_are_those_of_the_package(
    height: int, width: int, installed: Path, photo: np.ndarray, tmp_path: Path
) -> None:
    rgb = photo[:height, :width]
    Image.fromarray(rgb).save(tmp_path / "photo.png")
    found = run_example(installed, pretrained_weights(), tmp_path / "photo.png", "0.5")
    expected = DeepDetect(backend="onnxruntime").detect(rgb)
    assert len(expected) > 20
    np.testing.assert_array_equal(found[:, :2], expected.xy)
    np.testing.assert_allclose(found[:, 2], expected.scores, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("height", "width"), [(256, 256), (123, 157), (17, 23)])
def test_the_points_are_those_of_the_package(
    height: int, width: int, installed: Path, photo: np.ndarray, tmp_path: Path
) -> None:
    pytest.importorskip("onnx", reason="needs onnx, which is for exporting only")
    from deepdetect.detector.onnx_files.export import OnnxOptions, write_onnx

    write_onnx("default", tmp_path / "points.onnx", OnnxOptions(maps=False))
    Image.fromarray(photo[:height, :width]).save(tmp_path / "photo.png")
    found = run_example(installed, tmp_path / "points.onnx", tmp_path / "photo.png")
    expected = PointDetector(2048).detect(photo[:height, :width])
    assert abs(len(found) - len(expected)) <= 0.02 * len(expected)
    places = np.column_stack([expected.xy, expected.sizes])
    gaps, nearest = cKDTree(found[:, :3]).query(places)
    assert (gaps < 0.05).mean() > 0.98
    assert np.median(np.abs(found[nearest, 4] - expected.scores)) < 1e-4
    assert np.median(np.abs(found[nearest, 3] - expected.angles)) < 0.01
