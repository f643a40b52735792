from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("pycolmap", reason="needs pycolmap: pip install 'deepdetect[sfm]'")
pytest.importorskip("h5py", reason="needs h5py: pip install 'deepdetect[sfm]'")
pytest.importorskip("matplotlib", reason="needs matplotlib")

SCRIPT = Path(__file__).parents[2] / "examples/visual_odometry.py"


@pytest.mark.slow
def test_the_errors_are_below_those_that_the_page_promises(shared: Path, tmp_path: Path) -> None:
    words = ["--methods", "DeepDetect", "SIFT", "-o", str(tmp_path)]
    done = subprocess.run(
        [sys.executable, str(SCRIPT), str(shared / "data/kitti-clip"), *words],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    errors = json.loads((tmp_path / "errors.json").read_text())
    for name in ("DeepDetect", "SIFT"):
        found = errors[name]
        assert found["frames"] == 51
        assert found["end_percent"] < 2
        assert found["segment_percent"] < 2
        assert found["end_deg_per_m"] < 0.02
        assert len((tmp_path / f"{name.lower()}.txt").read_text().splitlines()) == 51
    assert (tmp_path / "trajectory.jpg").stat().st_size > 10_000


def test_an_unknown_method_is_refused(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(SCRIPT), str(tmp_path), "--methods", "Deepdetect"],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert "invalid choice: 'Deepdetect'" in done.stderr
