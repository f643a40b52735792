from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from tests.command_line import run_section


@pytest.mark.slow
def test_the_page_runs(
    write_fountain, pycolmap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(write_fountain(tmp_path / "photos"), tmp_path / "frames")
    calibration = {"focal_px": [344.935, 345.52], "cx": 189.65, "cy": 125.41}
    (tmp_path / "calib.json").write_text(json.dumps(calibration))
    monkeypatch.chdir(tmp_path)
    # What is shared is large, as its figures are.
    assert run_section("reconstruction.md", "Many images", lambda text: "../shared" in text) == 4
    for folder in ("model", "sequence"):
        values = json.loads((tmp_path / folder / "model.json").read_text())
        assert values["registered"] == 4
        assert values["dense_points"] > 1000
