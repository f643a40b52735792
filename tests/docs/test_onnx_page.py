"""The Python of docs/other-programs.md on ONNX runs, and finds what the page says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("onnx", reason="needs onnx, which is for exporting only")

from deepdetect import DeepDetect
from deepdetect.detector.network.onnx_export import write_onnx
from tests.docs.test_pages import blocks


def test_keypoints_in_the_file(
    photo: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_onnx("default", "deepdetect.onnx")
    Image.fromarray(photo[:123, :157]).save("photo.jpg", quality=100)
    block = blocks("other-programs.md", "python")[-1]
    found: dict[str, Any] = {}
    exec(compile(block, "other-programs.md", "exec"), found)
    expected = DeepDetect(backend="onnxruntime").detect(
        "photo.jpg", max_keypoints=1000, nms_radius=1, subpixel=True
    )
    order = np.argsort(-expected.logits, kind="stable")
    assert 100 < len(expected) < 1000
    np.testing.assert_allclose(found["xy"], expected.xy[order], atol=1e-3)
