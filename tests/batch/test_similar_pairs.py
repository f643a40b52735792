"""Which images of a collection are alike."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from deepdetect import Keypoints
from deepdetect.batch import extract_features, match_pairs, read_pairs
from deepdetect.batch.extraction import feature_group
from deepdetect.batch.hdf5 import Group, write_groups
from deepdetect.batch.similar_pairs import COMPARED_ROWS, most_alike, similar_pairs, vlad_vectors
from deepdetect.detector.point_detector import PointDetector
from deepdetect.features.sift import to_root_sift


def described(image: np.ndarray) -> np.ndarray:
    found = to_root_sift(cv2.SIFT_create().detectAndCompute(image, None)[1].astype(np.uint8))
    found = found.astype(np.float32)
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def group(name: str, descriptors: np.ndarray) -> Group:
    xy = np.zeros((len(descriptors), 2), np.float32)
    points = Keypoints(xy, np.ones(len(xy), np.float32), (8, 8), descriptors=descriptors)
    return feature_group(name, points)


def test_views_of_one_thing_are_more_alike_than_others(tmp_path: Path) -> None:
    pytest.importorskip("h5py", reason="needs h5py")
    data = pytest.importorskip("skimage.data", reason="needs scikit-image for its photographs")
    crops = []
    color = (data.astronaut(), data.coffee(), data.chelsea())
    for picture in (data.camera(), *(cv2.cvtColor(each, cv2.COLOR_RGB2GRAY) for each in color)):
        crops += [picture[:200, :260], picture[20:220, 40:300]]
    found = [described(np.ascontiguousarray(crop)) for crop in crops]
    vectors, rows = vlad_vectors(len(found), found.__getitem__)
    assert rows.tolist() == [*range(8)]
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-5)
    write_groups(tmp_path / "f.h5", [group(str(k), each) for k, each in enumerate(found)])
    pairs = similar_pairs(tmp_path / "f.h5", [str(k) for k in range(8)], 1)[0]
    assert pairs == [("0", "1"), ("2", "3"), ("4", "5"), ("6", "7")]


def test_photographs_that_cannot_be_compared_are_named(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="needs h5py")
    rng = np.random.default_rng(0)
    given = {name: rng.normal(size=(30, 64)).astype(np.float32) for name in "abcdef"}
    given["b"] = given["b"][:0]  # black: nothing is wrong with it
    given["e"] = rng.normal(size=(30, 128)).astype(np.float32)
    path = tmp_path / "f.h5"
    write_groups(path, [group(name, each) for name, each in given.items()])
    with h5py.File(path, "r+") as file:
        file["d/descriptors"][:, 3] = np.nan  # damaged
        del file["f/descriptors"]
    pairs, failures = similar_pairs(path, "acbdfe", 3)
    assert pairs == [("a", "c")]
    assert len(failures) == 3
    report = match_pairs(path, "similar", tmp_path / "m.h5", workers=1)
    assert ([*report.counts], len(report.failures)) == ([("a", "c")], 3)
    assert similar_pairs(path, "b", 3) == ([], [])
    assert similar_pairs(path, "bd", 3)[0] == []


def test_the_vocabulary_is_of_photographs_with_descriptors(monkeypatch) -> None:
    monkeypatch.setattr("deepdetect.batch.similar_pairs.TRAINING_IMAGES", 1)
    few = [np.empty((0, 8), np.float32)] * 30 + [np.eye(8, dtype=np.float32)] * 2
    vectors, rows = vlad_vectors(len(few), few.__getitem__)
    assert (len(vectors), rows.tolist()) == (2, [30, 31])


@pytest.mark.parametrize("loop", [False, True])
def test_of_a_large_set_those_that_see_the_same_are_matched(tmp_path: Path, loop: bool) -> None:
    """Photographs along a wall, or around a house: each sees 120 things, most new after four."""
    pytest.importorskip("h5py", reason="needs h5py")
    count = 51
    rng = np.random.default_rng(2)
    things = rng.normal(size=(30 * count + (0 if loop else 120), 128)).astype(np.float32)
    seen = {}
    for k in rng.permutation(count).tolist():
        own = things[np.arange(30 * k, 30 * k + 120) % len(things)]
        own = own + 0.3 * rng.normal(size=(120, 128))
        strange = rng.normal(size=(80, 128))  # leaves, and what moves
        seen[f"{k:03}"] = np.concatenate([own, strange]).astype(np.float32)
    write_groups(tmp_path / "f.h5", [group(*each) for each in seen.items()])
    pairs = similar_pairs(tmp_path / "f.h5", [*seen], 6)[0]
    assert len(pairs) <= 6 * count < count * (count - 1) / 2
    found = {tuple(sorted(map(int, pair))) for pair in pairs}
    assert len(found) == len(pairs)
    for step, share in ((1, 1.0), (2, 0.95)):  # three and two quarters in common
        others = [(k, (k + step) % count) for k in range(count if loop else count - step)]
        asked = {tuple(sorted(pair)) for pair in others}
        assert len(asked & found) >= share * len(asked)


def test_the_most_alike_are_those_of_all_products() -> None:
    rng = np.random.default_rng(1)
    vectors = rng.normal(size=(COMPARED_ROWS + 40, 16)).astype(np.float32)
    products = vectors @ vectors.T
    np.fill_diagonal(products, -np.inf)
    expected = np.sort(np.argsort(-products, axis=1)[:, :5], axis=1)
    found = [*most_alike(vectors, 5)]
    np.testing.assert_array_equal(np.sort(found, axis=1), expected)
    assert [sorted(each) for each in most_alike(vectors[:3], 5)] == [[1, 2], [0, 2], [0, 1]]


def test_a_collection_is_matched_by_likeness(collection: Callable[..., Path], tmp_path) -> None:
    pytest.importorskip("h5py", reason="needs h5py")
    path = tmp_path / "features.h5"
    extract_features(collection(5), path, PointDetector(300), workers=1)
    report = match_pairs(path, "similar:1", tmp_path / "m.h5", workers=1)
    numbers = [[int(Path(name).stem) for name in pair] for pair in report.counts]
    assert 3 <= len(numbers) <= 5
    assert all(abs(first - second) == 1 for first, second in numbers)
    assert sorted(read_pairs(tmp_path / "m.h5.pairs.txt")) == [*report.counts]
    whole = match_pairs(path, "similar", tmp_path / "all.h5", workers=1)
    assert len(whole.counts) == 10
