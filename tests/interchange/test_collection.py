from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.ExifTags import Base

from deepdetect import ImageError, Keypoints, OptionError, PointDetector
from deepdetect.features.sift import describe_keypoints
from deepdetect.interchange import Collection, PairMatches, describe_collection
from deepdetect.interchange.collection import check_upright
from deepdetect.interchange.colmap import write_colmap_text
from deepdetect.interchange.hloc import write_hloc
from deepdetect.io.image import luma
from deepdetect.sfm.colmap import sift_bytes


def test_each_keypoint_is_matched_once() -> None:
    rng = np.random.default_rng(0)
    rows, scores = rng.integers(-1, 20, (200, 2)), rng.random(200)
    found = PairMatches.one_to_one(rows, scores)
    for side in (0, 1):
        assert len(np.unique(found.rows[:, side])) == len(found)
    assert (found.rows >= 0).all()
    best = np.flatnonzero((rows >= 0).all(1))
    best = best[scores[best].argmax()]
    assert rows[best].tolist() in found.rows.tolist()


def test_matches_of_other_keypoints_are_refused() -> None:
    points = Keypoints([[1, 2]], [1], (8, 8))
    for rows, name in (([[0, 1]], "b"), ([[0, 0]], "c")):
        with pytest.raises(OptionError, match=name):
            Collection({"a": points, "b": points}, {("a", name): PairMatches(np.array(rows), [1])})


def test_descriptors_come_from_the_photographs(photo: np.ndarray, tmp_path: Path) -> None:
    Image.fromarray(photo).save(tmp_path / "p.png")
    points = PointDetector(50).detect(photo)
    pixels = Keypoints(np.rint(points.xy), points.scores, points.image_size)
    found = describe_collection(Collection({"p.png": points}, {}, tmp_path)).keypoints["p.png"]
    expected = describe_keypoints(luma(photo), points).descriptors
    np.testing.assert_array_equal(found.descriptors, expected)
    dense = describe_collection(Collection({"p.png": pixels}, {}, tmp_path)).keypoints["p.png"]
    assert dense.descriptors.shape == (len(points), 128)
    other = Keypoints([[1, 1]], [1], (99, 99))
    with pytest.raises(ImageError, match="99x99"):
        describe_collection(Collection({"p.png": other}, {}, tmp_path))
    assert describe_collection(Collection({"q.png": points})).keypoints["q.png"].descriptors is None


def test_photographs_of_16_bits_have_one_range(photo: np.ndarray, tmp_path: Path) -> None:
    gray = luma(photo).astype(np.uint16)
    for name, factor in {"dark.png": 4, "light.png": 16}.items():
        Image.fromarray(gray * factor).save(tmp_path / name)
    points = PointDetector(50).detect(photo)
    found = describe_collection(
        Collection(dict.fromkeys(["dark.png", "light.png"], points), {}, tmp_path)
    )
    dark = np.rint(gray * 4 * (255 / 4095)).astype(np.uint8)
    expected = describe_keypoints(dark, points).descriptors
    np.testing.assert_array_equal(found.keypoints["dark.png"].descriptors, expected)


def test_descriptors_as_bytes() -> None:
    rng = np.random.default_rng(0)
    bytes_ = rng.integers(0, 255, (4, 128)).astype(np.uint8)
    sizes = {"xy": np.zeros((4, 2)), "scores": np.ones(4), "image_size": (9, 9)}
    assert sift_bytes(Keypoints(**sizes, descriptors=bytes_)) is not None
    unit = bytes_ / np.linalg.norm(bytes_, axis=1, keepdims=True)
    found = sift_bytes(Keypoints(**sizes, descriptors=unit))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 512, atol=3)
    assert sift_bytes(Keypoints(**sizes, descriptors=-unit)) is None
    assert sift_bytes(Keypoints(**sizes, descriptors=unit[:, :64])) is None
    assert sift_bytes(Keypoints(**sizes)) is None


@pytest.mark.parametrize("write", [write_hloc, write_colmap_text])
def test_lists_of_names_with_blanks_cannot_be_read_back(write, small_collection, tmp_path) -> None:
    """`a b.jpg c.jpg` on a line is no pair."""
    keypoints = {
        "a b.jpg": small_collection.keypoints["a.jpg"],
        "c.jpg": small_collection.keypoints["c.jpg"],
    }
    matches = {("a b.jpg", "c.jpg"): small_collection.matches["c.jpg", "a.jpg"]}
    with pytest.raises(OptionError, match=r"b\.jpg"):
        write(Collection(keypoints, matches), tmp_path / "made")
    assert not (tmp_path / "made").exists()
    write(Collection(keypoints), tmp_path / "made")


def test_the_file_of_the_matches_replaces_no_other(small_collection, tmp_path) -> None:
    keypoints = {"matches": small_collection.keypoints["a.jpg"]}
    with pytest.raises(OptionError):
        write_colmap_text(Collection(keypoints), tmp_path / "made")
    assert not (tmp_path / "made").exists()


def test_photographs_that_exif_turns(tmp_path: Path) -> None:
    """They are refused where a reader would take their size from the file, as it is stored."""
    exif = Image.Exif()
    exif[Base.Orientation] = 8
    Image.new("RGB", (20, 10)).save(tmp_path / "turned.jpg", exif=exif)
    Image.new("RGB", (20, 10)).save(tmp_path / "upright.jpg")
    (tmp_path / "broken.jpg").write_bytes(b"no image")
    exif[Base.Orientation] = 0  # what some cameras write, and turns nothing
    Image.new("RGB", (20, 10)).save(tmp_path / "unset.jpg", exif=exif)
    others = [tmp_path / f"{name}.jpg" for name in ("upright", "broken", "unset")]
    check_upright(others)
    with pytest.raises(OptionError, match=r"turned\.jpg"):
        check_upright([*others, tmp_path / "turned.jpg"])
