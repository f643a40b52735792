from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect._shared.errors import OptionError
from deepdetect.geometry.point_cloud import PointCloud
from deepdetect.io.point_cloud import (
    POINT_CLOUD_WRITERS,
    save_point_cloud,
)


@pytest.mark.parametrize("ending", sorted(POINT_CLOUD_WRITERS))
def test_every_exporter_writes_a_whole_file(ending: str, small: PointCloud, tmp_path: Path) -> None:
    path = tmp_path / "new folder" / f"model{ending.upper()}"
    save_point_cloud(small, path, {"points": np.int64(256), "seconds": np.float32(1.5)})
    assert [file.name for file in path.parent.iterdir()] == [path.name]
    first = path.read_bytes()
    save_point_cloud(small, path, {"points": 256, "seconds": 1.5})
    assert path.read_bytes() == first


@pytest.mark.parametrize("ending", sorted(POINT_CLOUD_WRITERS))
def test_an_empty_cloud_is_not_written(ending: str, tmp_path: Path) -> None:
    empty = PointCloud(np.empty((0, 3)), np.empty((0, 3), np.uint8), "mm")
    with pytest.raises(OptionError):
        save_point_cloud(empty, tmp_path / f"model{ending}")
    assert not list(tmp_path.iterdir())
