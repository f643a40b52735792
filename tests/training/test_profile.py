from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("torch", reason="needs torch, which is for training only")


def test_profile_times_each_stage_and_writes_no_weights(photographs: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "deepdetect", "train", str(photographs), "-o"]
    command += [str(tmp_path / "run"), "--profile", "--stage", "64x4x4", "--stage", "96x2x1"]
    command += ["--short-side", "96", "--detectors", "fast", "--precision", "float32"]
    command += ["--no-compile", "--threads", "1", "--workers", "1", "--device", "cpu"]
    done = subprocess.run([*command, "--json"], capture_output=True, text=True, check=True)
    first, second = json.loads(done.stdout)
    assert (first["stage"]["crop"], second["stage"]["crop"]) == (64, 96)
    assert first["steps"] == 11 * 4 // 4 - 5
    assert second["steps"] == 1, "as many as the stage has, the warm-up left out"
    for stage in (first, second):
        assert stage["images_per_second"] > 0
        assert stage["full_images_per_second"] == pytest.approx(
            stage["images_per_second"] * stage["stage"]["crop"] ** 2 / 480**2
        )
        assert 0 <= stage["waiting_share"] < 1
        assert 50e6 < stage["memory"] < 20e9
        assert stage["device_memory"] is None
    assert {path.name for path in (tmp_path / "run").iterdir()} == {"labels"}
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "waiting for data" in shown
    assert "4 crops of 64x64" in shown
