from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect import DeepDetectError, Keypoints, OptionError
from deepdetect.interchange import Collection
from deepdetect.interchange.opencv import write_opencv


def numbers(node) -> list[float]:
    return [node.at(k).real() for k in range(node.size())]


@pytest.mark.parametrize("form", ["yml", "yml.gz", "xml", "json"])
def test_opencv_reads_what_is_written(
    form: str, small_collection: Collection, tmp_path: Path
) -> None:
    import cv2

    files = write_opencv(small_collection, tmp_path, file_format=form)
    assert sorted(str(path.relative_to(tmp_path)) for path in files) == sorted(
        f"{name}.{form}" for name in ("a.jpg", "sub/b.jpg", "c.jpg", "matches")
    )
    assert len([path for path in tmp_path.rglob("*") if path.is_file()]) == 4
    storage = cv2.FileStorage(str(tmp_path / f"sub/b.jpg.{form}"), cv2.FileStorage_READ)
    points = small_collection.keypoints["sub/b.jpg"]
    assert storage.getNode("image").string() == "sub/b.jpg"
    assert numbers(storage.getNode("image_size")) == [120, 110]
    node = storage.getNode("keypoints")
    assert node.isSeq()
    # The order in which C++ reads a KeyPoint: pt.x, pt.y, size, angle, response, octave, class_id.
    rows = np.array([numbers(node.at(k)) for k in range(node.size())])
    expected = [
        (*point.pt, point.size, point.angle, point.response, point.octave, point.class_id)
        for point in points.to_opencv()
    ]
    np.testing.assert_allclose(rows, expected, rtol=1e-6)
    descriptors = storage.getNode("descriptors").mat()
    assert descriptors.dtype == np.uint8
    np.testing.assert_array_equal(descriptors, points.descriptors)
    storage.release()
    storage = cv2.FileStorage(str(tmp_path / f"matches.{form}"), cv2.FileStorage_READ)
    pairs = storage.getNode("pairs")
    assert pairs.size() == 2
    first = pairs.at(0)
    names = first.getNode("image0").string(), first.getNode("image1").string()
    assert names == ("a.jpg", "sub/b.jpg")
    node = first.getNode("matches")
    # queryIdx, trainIdx, imgIdx, distance.
    assert [numbers(node.at(k)) for k in range(2)] == [[0, 3, 0, 0.25], [5, 1, 0, 0.5]]


def test_no_keypoints_no_matches_and_other_formats(tmp_path: Path) -> None:
    import cv2

    empty = Collection({"a": Keypoints.empty((8, 8))})
    path, matches = write_opencv(empty, tmp_path)
    storage = cv2.FileStorage(str(path), cv2.FileStorage_READ)
    assert storage.getNode("keypoints").size() == 0
    assert cv2.FileStorage(str(matches), cv2.FileStorage_READ).getNode("pairs").size() == 0
    with pytest.raises(OptionError, match="did you mean"):
        write_opencv(empty, tmp_path, file_format="yaml")


def test_a_file_is_whole_or_not_there(small_collection, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(
        "deepdetect.interchange.opencv._write_keypoints",
        lambda *_: (_ for _ in ()).throw(DeepDetectError("stopped")),
    )
    with pytest.raises(DeepDetectError, match="stopped"):
        write_opencv(small_collection, tmp_path / "out")
    assert not [path for path in (tmp_path / "out").rglob("*") if path.is_file()]
