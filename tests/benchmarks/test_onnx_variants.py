from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from PIL import Image

onnx = pytest.importorskip("onnx", reason="needs onnx, which is for exporting only")

from deepdetect.detector.network.onnx_export import OnnxOptions, write_onnx  # noqa: E402
from deepdetect.io.image import luma  # noqa: E402
from deepdetect.labels import fuse  # noqa: E402


@pytest.fixture(scope="module")
def script(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("onnx_variants")


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory, photo: np.ndarray) -> list[Path]:
    """A sample in normal light and a dark one."""
    folder = tmp_path_factory.mktemp("samples")
    for name, rgb in (("1", photo[:96, :128]), ("2", photo[:96, :128] // 8)):
        Image.fromarray(rgb).save(folder / f"image_{name}.png")
        mask = fuse(luma(np.ascontiguousarray(rgb))).mask
        Image.fromarray(mask).save(folder / f"mask_image_{name}.png")
    return sorted(folder.glob("image_*.png"))


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file without keypoints."""
    path = tmp_path_factory.mktemp("maps") / "maps.onnx"
    write_onnx("default", path, OnnxOptions(max_keypoints=0))
    return path


def test_half_precision_beside_the_whole(
    script: ModuleType, maps: Path, samples: list[Path], tmp_path: Path
) -> None:
    half = tmp_path / "half.onnx"
    write_onnx("default", half, OnnxOptions(precision="fp16", max_keypoints=0))
    table = script.precision_table({"fp32": maps, "fp16": half}, samples, rounds=0)
    assert list(table.columns)[2:4] == ["normal: BCE / IoU", "low: BCE / IoU"]
    whole, fewer = table.rows[:2]
    names = "precision", "pixels that cross", "time"
    assert [whole[name] for name in names] == ["fp32", 0, 1]
    assert whole["MB"] == maps.stat().st_size / 1e6
    assert fewer["MB"] < 0.55 * whole["MB"]
    assert 0 <= fewer["pixels that cross"] < 0.002
    assert np.isnan(fewer["time"])
    for kind in ("normal", "low"):
        loss, overlap = map(float, whole[f"{kind}: BCE / IoU"].split(" / "))
        assert 0 < loss < 1
        assert 0.3 < overlap < 1
