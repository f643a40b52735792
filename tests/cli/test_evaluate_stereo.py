from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from deepdetect.cli import main


@pytest.mark.slow
def test_the_command_prints_a_row_for_each(photo: np.ndarray, tmp_path: Path) -> None:
    left, right = photo[:80, 60:174], photo[:80, 66:180]
    for name, image in (("left", left), ("right", right)):
        Image.fromarray(image).save(tmp_path / f"{name}.png")
    Image.fromarray(np.full(left.shape[:2], 24, np.uint8)).save(tmp_path / "disparity.png")
    truth = {"file": "disparity.png", "value_per_pixel": 4, "unknown": 0}
    (tmp_path / "calib.json").write_text(json.dumps({"ground_truth": truth}))
    arguments = [
        "evaluate-stereo",
        str(tmp_path),
        "--label-settings",
        "dense",
        "--weights",
        "default",
    ]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    for source in ("labels dense", "weights default", "random, as weights", "all pixels"):
        assert source in result.output
    result = CliRunner().invoke(main, [*arguments, "--json"])
    rows = json.loads(result.stdout)
    assert len(rows) == 5
    assert rows[0]["precision"] > 0.9
