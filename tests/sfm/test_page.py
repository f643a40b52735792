"""The commands and snippets of docs/reconstruction.md, "Many images", run in their order."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.command_line import run_command

PAGE = (Path(__file__).parents[2] / "docs/reconstruction.md").read_text(encoding="utf-8")
PAGE = PAGE.partition("\n## Many images\n")[2].partition("\n## ")[0]
BLOCKS = re.findall(r"^```(sh|python)\n(.*?)^```", PAGE, re.S | re.M)


@pytest.mark.slow
def test_the_page_runs(
    write_fountain, pycolmap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(write_fountain(tmp_path / "photos"), tmp_path / "frames")
    calibration = {"focal_px": [344.935, 345.52], "cx": 189.65, "cy": 125.41}
    (tmp_path / "calib.json").write_text(json.dumps(calibration))
    monkeypatch.chdir(tmp_path)
    done = 0
    for language, text in BLOCKS:
        if language == "python":
            ran = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True)
            assert ran.returncode == 0, ran.stderr
            done += 1
            continue
        for line in text.splitlines():
            words = shlex.split(line.partition("#")[0])
            if words[:1] != ["deepdetect"] or "../shared" in line:  # large, as its figures are
                continue
            result = run_command(words[1:])
            assert result.exit_code == 0, f"{line}\n{result.output}"
            done += 1
    assert done == 4
    for folder in ("model", "sequence"):
        values = json.loads((tmp_path / folder / "model.json").read_text())
        assert values["registered"] == 4
        assert values["dense_points"] > 1000
