from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from tests.command_line import run_section

from deepdetect.tracking.video import write_video


@pytest.mark.slow
def test_the_page_runs(
    shared: Path, moving_photo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "frames").mkdir()
    for path in sorted((shared / "data" / "kitti-clip").glob("*.jpg"))[:8]:
        shutil.copy(path, tmp_path / "frames")
    monkeypatch.chdir(tmp_path)
    with write_video("drive.mp4", 10) as write:
        for k in range(8):
            write(moving_photo(k))
    # There is no camera 0.
    assert run_section("many-images.md", "Videos", lambda text: "track 0" in text) == 2
    assert {path.name for path in tmp_path.iterdir()} >= {"frames.csv", "frames.mp4"}
