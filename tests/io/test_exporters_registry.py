from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect._shared.errors import DeepDetectError, OptionError
from deepdetect.geometry.point_cloud import PointCloud
from deepdetect.io.exporters import EXPORTERS, get_exporter, save_point_cloud


@pytest.mark.parametrize("ending", sorted(EXPORTERS))
def test_every_exporter_writes_a_whole_file(ending: str, small: PointCloud, tmp_path: Path) -> None:
    path = tmp_path / "new folder" / f"model{ending.upper()}"
    save_point_cloud(small, path, {"points": np.int64(256), "seconds": np.float32(1.5)})
    assert [file.name for file in path.parent.iterdir()] == [path.name]
    first = path.read_bytes()
    save_point_cloud(small, path, {"points": 256, "seconds": 1.5})
    assert path.read_bytes() == first


@pytest.mark.parametrize("ending", sorted(EXPORTERS))
def test_one_point_will_do(ending: str, tmp_path: Path) -> None:
    cloud = PointCloud([[1.0, 2.0, 3.0]], [[1, 2, 3]], "mm")
    save_point_cloud(cloud, tmp_path / f"one{ending}")
    assert (tmp_path / f"one{ending}").stat().st_size > 15


@pytest.mark.parametrize(
    ("name", "meant"), [("a.pyl", ".ply"), ("a.gltf", ".glb"), ("a.htm", ".html")]
)
def test_the_nearest_ending_is_named(name: str, meant: str, one_line) -> None:
    with pytest.raises(OptionError) as caught:
        get_exporter(name)
    assert f"did you mean {meant!r}?" in one_line(caught.value)


def test_no_ending_is_an_error(small: PointCloud, tmp_path: Path, one_line) -> None:
    with pytest.raises(OptionError) as caught:
        save_point_cloud(small, tmp_path / "model")
    assert ".ply, .glb, .html" in one_line(caught.value)


@pytest.mark.parametrize("ending", sorted(EXPORTERS))
def test_an_empty_cloud_is_not_written(ending: str, tmp_path: Path, one_line) -> None:
    empty = PointCloud(np.empty((0, 3)), np.empty((0, 3), np.uint8), "mm")
    with pytest.raises(OptionError) as caught:
        save_point_cloud(empty, tmp_path / f"model{ending}")
    assert "no points" in one_line(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_path_that_cannot_be_written_is_one_sentence(
    small: PointCloud, tmp_path: Path, one_line
) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(DeepDetectError) as caught:
        save_point_cloud(small, tmp_path / "file" / "model.ply")
    assert "cannot write" in one_line(caught.value)
