"""Bundler itself is not packaged anywhere: its files are read by the rules of its source
(`ReadKeyFile`, `LoadKeys`, `LoadMatchTable`), and by the pixel centres of `LoadKeys`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect import Camera, Keypoints, OptionError
from deepdetect.interchange import Collection
from deepdetect.interchange.bundler import write_bundler
from deepdetect.sfm.lens import Lens


def read_key_file(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """As Bundler reads Lowe's text: a stream of numbers, whatever the lines are."""
    words = path.read_text().split()
    count, length = int(words[0]), int(words[1])
    table = np.array(words[2:], float).reshape(count, 4 + length)
    return table[:, :4], table[:, 4:]


def test_bundler_reads_what_is_written(small_collection: Collection, tmp_path: Path) -> None:
    lenses = {
        "a.jpg": Lens.of_camera(Camera((120, 110), 99.5)),
        "sub/b.jpg": Lens.initial((120, 110)),
    }
    files = write_bundler(small_collection, tmp_path, lenses=lenses)
    assert {str(path.relative_to(tmp_path)) for path in files} == {
        *("a.key", "sub/b.key", "c.key", "list.txt", "matches.init.txt")
    }
    # A guessed focal length is none.
    assert (tmp_path / "list.txt").read_text() == "a.jpg 0 99.5000\nsub/b.jpg\nc.jpg\n"
    for name, key in (("a.jpg", "a.key"), ("sub/b.jpg", "sub/b.key")):
        points = small_collection.keypoints[name]
        frames, descriptors = read_key_file(tmp_path / key)
        np.testing.assert_allclose(frames[:, 1], points.xy[:, 0], atol=1e-3)
        np.testing.assert_allclose(frames[:, 0], points.xy[:, 1], atol=1e-3)
        np.testing.assert_allclose(frames[:, 2], points.sizes / 2, atol=1e-3)
        turned = (np.degrees(frames[:, 3]) + points.angles + 180) % 360 - 180
        np.testing.assert_allclose(turned, 0, atol=0.02)  # the other way round
        assert np.abs(frames[:, 3]).max() <= np.pi + 1e-3
        np.testing.assert_array_equal(descriptors, points.descriptors)
    words = list(map(int, (tmp_path / "matches.init.txt").read_text().split()))
    assert words == [0, 1, 2, 0, 3, 5, 1, 2, 0, 1, 2, 2]


def test_the_centre_of_the_image_is_bundlers_origin(tmp_path: Path) -> None:
    """`LoadKeys`: x - (width - 1) / 2, and (height - 1) / 2 - y."""
    descriptors = np.zeros((1, 128), np.uint8)
    middle = Keypoints([[59.5, 54.5]], [1], (120, 110), descriptors=descriptors)
    write_bundler(Collection({"a.jpg": middle}), tmp_path)
    ((row, column, *_),) = read_key_file(tmp_path / "a.key")[0]
    assert (column - 0.5 * (120 - 1), (110 - row - 1) - 0.5 * (110 - 1)) == (0, 0)
    assert not (tmp_path / "matches.init.txt").exists()


@pytest.mark.parametrize(
    ("names", "described", "words"),
    [
        (("a b.jpg",), True, "blanks"),
        (("a.jpg", "a.png"), True, "the same a.key"),
        (("a.jpg",), False, "SIFT descriptors"),
    ],
)
def test_what_the_format_does_not_hold(
    names: tuple[str, ...], described: bool, words: str, tmp_path: Path, one_line
) -> None:
    descriptors = np.zeros((1, 128), np.uint8) if described else None
    points = Keypoints([[1, 1]], [1], (120, 110), descriptors=descriptors)
    with pytest.raises(OptionError) as caught:
        write_bundler(Collection(dict.fromkeys(names, points)), tmp_path / "out")
    assert words in one_line(caught.value)
    assert not (tmp_path / "out").exists()
