from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from skimage import data
from tests.cli.conftest import one_sentence
from tests.command_line import run_command

FILES = {"report.md", "report.json", "tables/foreground.csv"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One small photograph with a mask."""
    root = tmp_path_factory.mktemp("data") / "foreground"
    root.mkdir()
    Image.fromarray(data.chelsea()[60:124, 90:170]).save(root / "cat.png")
    mask = np.zeros((64, 80), np.uint8)
    mask[:, :40] = 255
    Image.fromarray(mask).save(root / "cat_mask.png")
    return root.parent


@pytest.fixture(scope="module")
def made(folder: Path, tmp_path_factory: pytest.TempPathFactory):
    """The first run, whose results the others find."""
    output = tmp_path_factory.mktemp("output")
    arguments = ["dev", "benchmark", "foreground", "--data", str(folder), "-o", str(output)]
    result = run_command([*arguments, "--baselines", "fast, harris"])
    assert result.exit_code == 0, result.output
    return result, output


def test_the_report_is_written_and_printed(made, folder: Path) -> None:
    result, output = made
    written = {path.relative_to(output).as_posix() for path in output.rglob("*") if path.is_file()}
    assert {path for path in written if not path.startswith("cache/")} == FILES
    assert any(path.startswith("cache/keypoints/") for path in written)
    assert "| FAST |" in result.stdout
    gray = cv2.cvtColor(cv2.imread(str(folder / "foreground" / "cat.png")), cv2.COLOR_BGR2GRAY)
    points = cv2.FastFeatureDetector_create().detect(gray, None)
    share = np.mean([p.pt[0] < 40 for p in points])
    rows = (output / "tables" / "foreground.csv").read_text().splitlines()
    (fast,) = [row.split(",") for row in rows if row.startswith("FAST,")]
    assert float(fast[1]) == pytest.approx(share)
    assert float(fast[4]) == pytest.approx(len(points) / gray.size)
    assert [row.split(",")[0] for row in rows[:3]] == ["method", "FAST", "Harris"]


def test_a_further_method_is_one_more_row_and_the_rest_is_found(made, folder: Path, run) -> None:
    _, output = made
    Path("own_corner_finder.py").write_text(
        "def find(rgb):\n    return {'keypoints': [[1, 1], [70, 1]], 'scores': [1, 1]}\n"
    )
    result = run(
        *("dev", "benchmark", "foreground", "--data", folder / "foreground", "-o", "out"),
        *("--baselines", "fast", "--method", "own_corner_finder:find", "--method", "agast"),
        *("--cache", output / "cache", "--json"),
    )
    assert result.exit_code == 0, result.output
    values = json.loads(result.stdout)
    rows = {row["method"]: row for row in values["tables"]["foreground"]["rows"]}
    assert list(rows)[:3] == ["FAST", "own_corner_finder:find", "AGAST"]
    assert rows["own_corner_finder:find"]["fraction on the foreground"] == 0.5
    assert values["metadata"]["results computed, not read from the cache"] == "2"


def test_what_fails_is_listed_and_the_rest_is_there(made, folder: Path, run) -> None:
    _, output = made
    Path("never_works.py").write_text("def find(rgb):\n    raise ValueError('not today')\n")
    arguments = (
        *("dev", "benchmark", "foreground", "--data", folder, "-o", "out", "--baselines", "fast"),
        *("--cache", output / "cache", "--method", "never_works:find"),
    )
    result = run(*arguments)
    assert result.exit_code == 1, result.output
    assert "| FAST |" in result.stdout
    assert "report: out/report.md" in result.stdout
    failure = result.stderr.splitlines()[-1].strip()
    assert "not today" in failure
    as_json = run(*arguments, "--json")
    assert as_json.exit_code == 1
    assert json.loads(as_json.stdout)["skipped"] == [failure]


@pytest.mark.parametrize(
    "arguments",
    [
        "foreground --protocol papers",
        "foreground --method none.onnx",
        "oxford",
        "pose --max-pairs 0",
    ],
)
def test_a_mistake_ends_with_exit_code_2(run, folder: Path, arguments: str) -> None:
    result = run("dev", "benchmark", *arguments.split(), "--data", folder, "-o", "out")
    assert result.exit_code == 2, result.output
    assert one_sentence(result.stderr)
    assert not Path("out").exists()
