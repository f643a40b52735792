"""The commands and snippets of docs/many-images.md, "Videos", run in their order."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.command_line import run_command

PAGE = (Path(__file__).parents[2] / "docs/many-images.md").read_text(encoding="utf-8")
PAGE = PAGE.partition("\n## Videos\n")[2].partition("\n## ")[0]
BLOCKS = re.findall(r"^```(sh|python)\n(.*?)^```", PAGE, re.S | re.M)


@pytest.mark.slow
def test_the_page_runs(
    shared: Path, moving_photo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import cv2

    (tmp_path / "frames").mkdir()
    for path in sorted((shared / "data" / "kitti-clip").glob("*.jpg"))[:8]:
        shutil.copy(path, tmp_path / "frames")
    monkeypatch.chdir(tmp_path)
    writer = cv2.VideoWriter("drive.mp4", cv2.VideoWriter_fourcc(*"mp4v"), 10, (320, 240))
    for k in range(8):
        writer.write(moving_photo(k)[:, :, ::-1])
    writer.release()
    done = 0
    for language, text in BLOCKS:
        if language == "python":
            ran = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True)
            assert ran.returncode == 0, ran.stderr
            done += 1
            continue
        for line in text.splitlines():
            words = shlex.split(line.partition("#")[0])
            if words[:1] != ["deepdetect"] or words[2] == "0":  # a camera
                continue
            result = run_command(words[1:])
            assert result.exit_code == 0, f"{line}\n{result.output}"
            done += 1
    assert done == 3
    assert {path.name for path in tmp_path.iterdir()} >= {"tracks.csv", "frames.csv", "frames.mp4"}
