from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect._shared.errors import OptionError
from deepdetect.geometry.point_cloud import PointCloud
from deepdetect.io.point_cloud import (
    POINT_CLOUD_WRITERS,
    find_writer,
    format_metadata,
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


@pytest.mark.parametrize(
    ("name", "meant"), [("a.pyl", ".ply"), ("a.gltf", ".glb"), ("a.htm", ".html")]
)
def test_the_nearest_ending_is_named(name: str, meant: str, one_line) -> None:
    with pytest.raises(OptionError) as caught:
        find_writer(name)
    assert f"did you mean {meant!r}?" in one_line(caught.value)


@pytest.mark.parametrize("ending", sorted(POINT_CLOUD_WRITERS))
def test_an_empty_cloud_is_not_written(ending: str, tmp_path: Path, one_line) -> None:
    empty = PointCloud(np.empty((0, 3)), np.empty((0, 3), np.uint8), "mm")
    with pytest.raises(OptionError) as caught:
        save_point_cloud(empty, tmp_path / f"model{ending}")
    assert "no points" in one_line(caught.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1234567, "1,234,567"),
        (np.int64(1200), "1,200"),
        (49979.0, "49,979"),
        (np.float32(0.95312), "0.9531"),
        (float("nan"), "nan"),
        (True, "True"),
        ("  two\n lines ", "two lines"),
    ],
)
def test_values_become_one_line(value: object, text: str) -> None:
    assert format_metadata({"a\nname": value}) == {"a name": text}
