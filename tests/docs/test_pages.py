"""The code and the commands of pages for newcomers run, and do what the pages say."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.command_line import run_command

DOCS = Path(__file__).parents[2] / "docs"


def blocks(name: str, language: str) -> list[str]:
    text = (DOCS / name).read_text("utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.M | re.S)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    pytest.importorskip("skimage.data", reason="needs scikit-image for its photographs")
    pytest.importorskip("numba", reason="needs numba for guided matching")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_first_steps(folder: Path) -> None:
    from skimage import data

    fetch, use = blocks("first-steps.md", "python")
    exec(compile(fetch, "first-steps.md", "exec"), {})
    lines = "\n".join(blocks("first-steps.md", "sh"))
    commands = re.findall(r"^deepdetect ([^#\n]+)", lines, re.M)
    assert len(commands) == 4
    for command in commands:
        result = run_command(shlex.split(command))
        assert result.exit_code == 0, result.output
    disparity = data.stereo_motorcycle()[2]
    known = np.isfinite(disparity)
    true = 994.978 * 193.001 / (disparity[known] + 31.086)  # of Middlebury 2014, in mm
    ratio = np.load("deepdetect-output/model_depth.npz")["depth"][known] / true
    np.testing.assert_allclose(np.nanpercentile(ratio, [5, 50, 95]), 1, atol=0.02)
    page = (DOCS / "first-steps.md").read_text("utf-8")
    for name in re.findall(r"`(?:deepdetect-output/)?((?:model|left)[\w.]+\.\w+)`", page):
        assert (folder / "deepdetect-output" / name).is_file() or (folder / name).is_file()
    exec(compile(use, "first-steps.md", "exec"), {})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("page", "count"),
    [
        ("python.md", 99),
        ("points.md", 2),
        ("comparison.md", 1),
        ("matching.md", 1),
        ("other-programs.md", 1),
    ],
)
def test_the_code_of_guides(folder: Path, page: str, count: int) -> None:
    """The first blocks of a page run, from top to bottom."""
    from skimage import data

    for name, view in zip(("left", "right"), data.stereo_motorcycle(), strict=False):
        Image.fromarray(view[100:420, 220:620]).save(f"{name}.png")
    found: dict[str, object] = {}
    for block in blocks(page, "python")[:count]:
        exec(compile(block, page, "exec"), found)


@pytest.mark.slow
def test_points_in_the_file(folder: Path, photo: np.ndarray) -> None:
    """The page's Python on ONNX finds what the package finds."""
    pytest.importorskip("onnx", reason="needs onnx, which is for exporting only")
    from deepdetect import PointDetector
    from deepdetect.detector.onnx_files.export import write_onnx

    write_onnx("default", "deepdetect.onnx")
    Image.fromarray(photo[:123, :157]).save("photo.jpg", quality=100)
    found: dict[str, object] = {}
    exec(compile(blocks("other-programs.md", "python")[-1], "other-programs.md", "exec"), found)
    expected = PointDetector(2048).detect("photo.jpg")
    gaps = np.linalg.norm(found["xy"][:, None] - expected.xy, axis=2)
    assert (gaps.min(0) < 0.05).mean() > 0.99


RECIPES = blocks("recipes.md", "python")


def write_photographs(folder: Path) -> None:
    """Write what the recipes name: a stereo pair, a plane from two places, a folder, a video."""
    import cv2
    from skimage import data

    left, right = (view[100:340, 220:540] for view in data.stereo_motorcycle()[:2])
    plane = data.astronaut()
    tilt = np.array([[0.9, 0.1, 5.0], [-0.1, 0.95, 20.0], [1e-4, 1e-4, 1.0]])
    tilted = cv2.warpPerspective(plane, tilt, plane.shape[1::-1])
    (folder / "photos").mkdir()
    named = {"left": left, "right": right, "field0": plane, "field1": tilted}
    named |= {"photos/a": left, "photos/b": right}
    for name, view in named.items():
        Image.fromarray(view).save(folder / f"{name}.jpg", quality=95)
    video = cv2.VideoWriter(
        str(folder / "video.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, (320, 240)
    )
    for start in range(0, 30, 5):
        video.write(np.ascontiguousarray(plane[100:340, start : start + 320, ::-1]))
    video.release()


@pytest.mark.slow
@pytest.mark.parametrize("number", range(len(RECIPES)))
def test_recipes(folder: Path, number: int) -> None:
    recipe = RECIPES[number]
    write_photographs(folder)
    found: dict[str, object] = {}
    exec(compile(recipe, "recipes.md", "exec"), found)
    if "matches" in found:
        assert found["matches"].inliers.sum() > 1000
    if "result" in found:
        truth = np.array([[0.9, 0.1, 5.0], [-0.1, 0.95, 20.0], [1e-4, 1e-4, 1.0]])
        np.testing.assert_allclose(found["result"].homography, truth, atol=0.5, rtol=0.02)


@pytest.mark.slow
def test_recipe_of_a_database(folder: Path) -> None:
    pytest.importorskip("pycolmap", reason="needs pycolmap")
    write_photographs(folder)
    (line,) = re.findall(r"^deepdetect (export colmap .*)$", blocks("recipes.md", "sh")[0], re.M)
    result = run_command(shlex.split(line))
    assert result.exit_code == 0, result.output
    assert (folder / "database.db").is_file()
