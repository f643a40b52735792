"""The Python of docs/other-programs.md on ONNX runs, and finds what the page says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("onnx", reason="needs onnx, which is for exporting only")

from tests.docs.test_pages import blocks

from deepdetect import PointDetector
from deepdetect.detector.network.onnx_export import write_onnx


def test_points_in_the_file(
    photo: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_onnx("default", "deepdetect.onnx")
    Image.fromarray(photo[:123, :157]).save("photo.jpg", quality=100)
    block = blocks("other-programs.md", "python")[-1]
    found: dict[str, Any] = {}
    exec(compile(block, "other-programs.md", "exec"), found)
    expected = PointDetector(2048).detect("photo.jpg")
    assert 300 < len(expected) < 2048
    assert abs(len(found["xy"]) - len(expected)) <= 2
    gaps = np.linalg.norm(found["xy"][:, None] - expected.xy, axis=2)
    assert (gaps.min(0) < 0.05).mean() > 0.99
