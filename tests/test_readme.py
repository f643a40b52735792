"""Every command of the README is run."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from skimage import data

from tests.command_line import run_command

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
SHELL = [
    line.split("#")[0].strip()
    for block in re.findall(r"```sh\n(.*?)```", README, re.S)
    for line in block.splitlines()
    if line.strip()
]
PYTHON = re.findall(r"```python\n(.*?)```", README, re.S)
TABLE = re.findall(r"^\| `(deepdetect [^`]*)`", README, re.M)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the files that the README's examples name."""
    left, right, _ = data.stereo_motorcycle()
    for name, view in (("left", left), ("right", right)):
        Image.fromarray(view[100:260, 300:500]).save(tmp_path / f"{name}.png")
    calibration = {"focal_px": 994.978, "baseline_mm": 193.001, "disparity_offset_px": 31.086}
    (tmp_path / "calib.json").write_text(json.dumps(calibration))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(words: list[str]) -> None:
    """Run a command line in this process."""
    result = run_command(words[1:])
    assert result.exit_code == 0, result.output


def test_it_starts_as_promised() -> None:
    """Badges, a sentence, a picture, two commands; six lines of Python, command lines."""
    title, badges, sentence, picture, *rest = [part for part in README.split("\n\n") if part]
    assert badges.startswith("[![")
    assert title == "# DeepDetect"
    assert sentence.count(". ") == 0
    assert sentence.endswith(".")
    assert re.fullmatch(r"!\[.*\]\((.*)\)", picture)
    assert (ROOT / picture.split("(")[1].rstrip(")")).stat().st_size > 10_000
    assert [line.split()[:2] for line in rest[0].splitlines()[1:-1]] == [
        ["make", "demo"],
        ["make", "test"],
    ]
    assert len([line for line in PYTHON[0].splitlines() if line]) <= 6
    commands = [line for line in SHELL if line.startswith("deepdetect ")]
    assert commands[:2] == ["deepdetect detect left.png", "deepdetect match left.png right.png"]


@pytest.mark.slow
def test_the_python_lines_run(folder: Path) -> None:
    for block in PYTHON:
        done = subprocess.run([sys.executable, "-c", block], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert int(done.stdout.split()[0]) > 100


@pytest.mark.parametrize("line", [line for line in SHELL if line.startswith("deepdetect ")])
def test_the_command_lines_run(folder: Path, line: str) -> None:
    run(shlex.split(line))
    assert list((folder / "deepdetect-output").glob("*.npz"))
    assert list((folder / "deepdetect-output").glob("*.jpg"))


SLOW = (
    "train",
    "shards",
    "evaluate",
    "evaluate-stereo",
    "benchmark",
    "demo",
    "average",
    "reconstruct",
)


@pytest.mark.slow
@pytest.mark.parametrize(
    "line",
    [
        pytest.param(line, marks=[pytest.mark.slow] if line.split()[1] in SLOW else [])
        for line in TABLE
    ],
)
def test_the_commands_of_the_table_run(
    folder: Path, line: str, request: pytest.FixtureRequest
) -> None:
    words = shlex.split(line)
    if "train" in words:
        pytest.importorskip("torch", reason="needs torch, which is for training only")
        words += [
            "--stage",
            "32x2x1",
            "--short-side",
            "32",
            "--detectors",
            "fast",
            "--val-count",
            "1",
        ]
        words += ["--no-compile", "--workers", "1", "--validation", "PHOTOS"]
    if "register" in words or "stitch" in words:  # they want a plane, or one place
        whole = data.astronaut()[:300]
        for name, start in (("left", 0), ("right", 130)):
            Image.fromarray(whole[:, start : start + 330]).save(folder / f"{name}.png")
    if "average" in words:
        pytest.importorskip("torch", reason="needs torch to read weights")
        words[words.index("WEIGHTS") : words.index("WEIGHTS") + 1] = ["default", "dense"]
    if "shards" in words:
        pytest.importorskip("webdataset", reason="needs webdataset, of the extra data")
        words += ["--detectors", "fast", "--short-side", "32", "--workers", "1"]
    if "evaluate" in words:
        (folder / "samples").mkdir()
        shutil.copy("left.png", "samples/image_1.png")
        mask = np.asarray(Image.open("left.png").convert("L")) > 100
        Image.fromarray(mask).save("samples/mask_image_1.png")
    if "evaluate-stereo" in words:
        shutil.copytree(folder, "scene", ignore=shutil.ignore_patterns("scene"))
        Image.fromarray(np.full((160, 200), 120, np.uint8)).save("scene/disparity.png")
        truth = {"file": "disparity.png", "value_per_pixel": 4, "unknown": 0}
        Path("scene/calib.json").write_text(json.dumps({"ground_truth": truth}))
    if "benchmark" in words:
        (folder / "masked").mkdir()
        shutil.copy("left.png", "masked/left.png")
        mask = np.asarray(Image.open("left.png").convert("L")) > 100
        Image.fromarray(mask).save("masked/left_mask.png")
    (folder / "photos").mkdir()
    shutil.copy("left.png", "photos")
    shutil.copy("right.png", "photos/another.png")
    places = {
        "IMAGES": "left.png",
        "IMAGE0": "left.png",
        "IMAGE1": "right.png",
        "DIR": "out",
        "PHOTOS": "photos",
        "LEFT": "left.png",
        "RIGHT": "right.png",
        "PX": "995",
        "SAMPLES": "samples",
        "SCENES": "scene",
        "NAME": "foreground",
        "DATA": "masked",
        "FOLDER": "photos",
        "PAIRS": "pairs.txt",
        "FILE": "network.onnx",
    }
    if "reconstruct" in words and "PHOTOS" in words:  # three photographs of one scene
        pytest.importorskip("pycolmap", reason="needs pycolmap, of the extra sfm")
        fountain = request.getfixturevalue("shared") / "data" / "fountain"
        for number in (4, 5, 6, 7):
            with Image.open(fountain / f"{number:04d}.jpg") as photograph:
                photograph.resize((768, 512)).save(folder / "photos" / f"{number}.jpg")
    if "extract" in words or "match-many" in words:
        pytest.importorskip("h5py", reason="needs h5py")
    if "match-many" in words:
        run(["deepdetect", "extract", "photos", "-o", "features.h5"])
        Path("pairs.txt").write_text("left.png another.png\n")
    if "export" in words and "onnx" in words:
        pytest.importorskip("onnx", reason="needs onnx, of the extra onnx")
    if "colmap" in words:
        pytest.importorskip("h5py", reason="needs h5py, of the extra sfm")
        pytest.importorskip("pycolmap", reason="needs pycolmap, of the extra sfm")
    run([places.get(word, word) for word in words])


@pytest.mark.slow
@pytest.mark.parametrize("line", re.findall(r"\| `([^`]*\([^`]*\))` \|$", README, re.M))
def test_the_calls_of_the_table_run(folder: Path, line: str) -> None:
    import deepdetect

    left = deepdetect.load_image("left.png")
    names = {
        **{name: getattr(deepdetect, name) for name in deepdetect.__all__},
        **{"detector": deepdetect.DeepDetect(), "points": deepdetect.PointDetector(500)},
        **{"image": left, "mask": left[..., 0] > 100},
        **{"a": left, "b": deepdetect.load_image("right.png")},
    }
    assert eval(line, names) is not None


@pytest.mark.slow
def test_make_demo_runs(tmp_path: Path) -> None:
    if Path(sys.prefix) != ROOT / ".venv" or shutil.which("make") is None:
        pytest.skip("needs make, and to be run by `make test` in .venv")
    done = subprocess.run(
        ["make", "demo", f"DEMO_OUTPUT={tmp_path}"], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    for word in ("keypoints", "density", "matches", "true disparity", "seconds: guided matching"):
        assert word in done.stdout
    pictures = {path.name.removeprefix("motorcycle_") for path in tmp_path.glob("*.jpg")}
    assert pictures == {
        "left_keypoints.jpg",
        "right_keypoints.jpg",
        "left_heatmap.jpg",
        "matches.jpg",
    }


def test_make_test_is_what_ci_runs() -> None:
    assert "make test" in (ROOT / ".ci" / "run").read_text()
    assert re.search(r"^test:", (ROOT / "Makefile").read_text(), re.M)


@pytest.mark.parametrize("line", [line for line in SHELL if line.startswith("pip install")])
def test_the_installs_name_extras_that_exist(line: str) -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    named = re.findall(r"\[(.*)\]", line)
    assert all(extra in extras for names in named for extra in names.split(","))


@pytest.mark.slow
def test_the_wheel_installs_and_detects(folder: Path) -> None:
    """`pip install .`, built and installed into an empty folder, with the weights inside."""
    pytest.importorskip("hatchling", reason="needs hatchling to build the wheel")
    target = folder / "site"
    done = subprocess.run(
        [
            *(sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"),
            *("--no-deps", "--no-build-isolation", "--target", str(target), str(ROOT)),
        ],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    weights = target / "deepdetect" / "detector" / "weights"
    for name in ("default", "dense", "free"):
        assert 0 < (weights / f"{name}.onnx").stat().st_size < 2_000_000
        assert 0 < (weights / f"{name}.safetensors").stat().st_size < 2_000_000
    for name in ("MODEL_CARD.md", "DENSE_CARD.md", "FREE_CARD.md"):
        assert (weights / name).exists()
    code = (
        f"import sys; sys.path.insert(0, {str(target)!r}); import deepdetect;"
        f"assert deepdetect.__file__.startswith({str(target)!r}), deepdetect.__file__;"
        "print(len(deepdetect.DeepDetect().detect('left.png')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 100
