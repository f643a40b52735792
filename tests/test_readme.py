"""The examples of the README run."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image
from skimage import data
from tests.command_line import run_command

from deepdetect.detector.pretrained import PRETRAINED

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
CALLS = (ROOT / "docs/python.md").read_text("utf-8")
SHELL = [
    line.split("#")[0].strip()
    for block in re.findall(r"```sh\n(.*?)```", README, re.S)
    for line in block.splitlines()
    if line.strip()
]
PYTHON = re.findall(r"```python\n(.*?)```", README, re.S)


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


@pytest.mark.slow
def test_the_python_lines_run(folder: Path) -> None:
    for block in PYTHON:
        done = subprocess.run([sys.executable, "-c", block], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert int(done.stdout.split()[0]) > 100


@pytest.mark.parametrize("line", [line for line in SHELL if line.startswith("deepdetect ")])
def test_the_command_lines_run(folder: Path, line: str) -> None:
    result = run_command(shlex.split(line)[1:])
    assert result.exit_code == 0, result.output
    assert list((folder / "deepdetect-output").glob("*.npz"))
    assert list((folder / "deepdetect-output").glob("*.jpg"))


@pytest.mark.slow
@pytest.mark.parametrize("line", re.findall(r"\| `([^`]*\([^`]*\))` \|$", CALLS, re.M))
def test_the_calls_of_the_table_run(folder: Path, line: str) -> None:
    import deepdetect

    left, right = deepdetect.load_image("left.png"), deepdetect.load_image("right.png")
    names = {
        **{name: getattr(deepdetect, name) for name in deepdetect.__all__},
        **{"detector": deepdetect.DeepDetect(), "points": deepdetect.PointDetector(500)},
        **{"image": left, "mask": left[..., 0] > 100},
        **{"a": left, "b": right, "matches": deepdetect.match_images(left, right)},
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
    for word in ("keypoints", "matches", "of ground truth", "seconds"):
        assert word in done.stdout
    pictures = {path.name.removeprefix("motorcycle_") for path in tmp_path.glob("*.jpg")}
    assert pictures == {
        "left_keypoints.jpg",
        "right_keypoints.jpg",
        "left_heatmap.jpg",
        "matches.jpg",
    }


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
    for name in PRETRAINED:
        assert 0 < (weights / f"{name}.onnx").stat().st_size < 2_000_000
    for name in ("MODEL_CARD.md", "DENSE_CARD.md", "FREE_CARD.md", "ESPNET_CARD.md"):
        assert (weights / name).exists()
    code = (
        f"import sys; sys.path.insert(0, {str(target)!r}); import deepdetect;"
        f"assert deepdetect.__file__.startswith({str(target)!r}), deepdetect.__file__;"
        "print(len(deepdetect.DeepDetect().detect('left.png')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 100
