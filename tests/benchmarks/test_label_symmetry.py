from __future__ import annotations

import subprocess
import sys
from pathlib import Path

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "label_symmetry.py"


def test_prints_a_row_for_each_detector(photo_path: Path) -> None:
    command = [sys.executable, str(BENCHMARK), str(photo_path.parent)]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    rows = [line.strip("| ").split(" | ") for line in printed.splitlines()[2:]]
    values = {name: [float(value) for value in row] for name, *row in rows}
    assert values["fast"] == [1, 1, 1]
    assert values["shi-tomasi"][2] == 1
    assert values["shi-tomasi"][0] < 0.1
