from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "paper_settings.py"
SCENES = ("bark", "bikes", "boat", "graf", "leuven", "trees", "ubc", "wall")


def test_the_density_is_opencvs_with_and_without_a_scene(tmp_path: Path, write_scene) -> None:
    means = {}
    for index, scene in enumerate(SCENES):
        corner = (100 + 17 * index, 30 + 11 * index)
        write_scene(tmp_path / scene, (64, 48), np.eye(3), corner=corner)
        images = [cv2.imread(str(tmp_path / scene / f"img{n}.png")) for n in range(1, 7)]
        grays = [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in images]
        found = [len(cv2.FastFeatureDetector_create().detect(gray, None)) for gray in grays]
        means[scene] = np.mean(found) / (64 * 48)
    command = [sys.executable, str(SCRIPT), str(tmp_path), "--only", "fast", "--without-matches"]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    (row,) = [line.strip("| ").split(" | ") for line in printed.splitlines() if "FAST" in line]
    assert row[:3] == ["FAST", "0.0270", f"{np.mean(list(means.values())):.4f}"]
    density, _, left_out = row[3].split()
    others = [value for scene, value in means.items() if scene != left_out]
    assert density == f"{np.mean(others):.4f}"
