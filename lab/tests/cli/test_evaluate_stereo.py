from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.command_line import run_command


@pytest.mark.slow
def test_the_command_prints_a_row_for_each(photo: np.ndarray, tmp_path: Path) -> None:
    left, right = photo[:80, 60:174], photo[:80, 66:180]
    for name, image in (("left", left), ("right", right)):
        Image.fromarray(image).save(tmp_path / f"{name}.png")
    Image.fromarray(np.full(left.shape[:2], 24, np.uint8)).save(tmp_path / "disparity.png")
    truth = {"file": "disparity.png", "value_per_pixel": 4, "unknown": 0}
    (tmp_path / "calib.json").write_text(json.dumps({"ground_truth": truth}))
    arguments = [
        "dev",
        "evaluate-stereo",
        str(tmp_path),
        "--label-settings",
        "dense",
        "--weights",
        "default",
    ]
    result = run_command(arguments)
    assert result.exit_code == 0, result.output
    for source in ("labels dense", "weights default", "random, as weights", "all pixels"):
        assert source in result.output
    result = run_command([*arguments, "--json"])
    rows = json.loads(result.stdout)
    assert len(rows) == 5
    assert rows[0]["precision"] > 0.9
    both = [*arguments[:2], str(tmp_path / "gone"), *arguments[2:]]
    result = run_command([*both, "--json"])
    assert result.exit_code == 1, result.output
    assert json.loads(result.stdout) == rows
    assert "1 of 2 scenes" in result.stderr
    assert str(tmp_path / "gone") in result.stderr.splitlines()[-1]


def test_scenes_none_of_which_can_be_read(tmp_path: Path) -> None:
    gone = [str(tmp_path / name) for name in ("first", "second")]
    result = run_command(["dev", "evaluate-stereo", *gone])
    assert result.exit_code == 2, result.output
    assert all(name in result.stderr for name in gone)
