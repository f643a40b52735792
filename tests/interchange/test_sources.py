from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("h5py", reason="needs h5py")

from deepdetect import (
    DeepDetectError,
    OptionError,
    PointDetector,
    match_images,
    save_keypoints,
    save_matches,
)
from deepdetect._shared.errors import BatchError
from deepdetect.batch import extract_features, match_pairs
from deepdetect.interchange import match_folder, read_collection


@pytest.fixture
def pair(tmp_path: Path) -> Path:
    """Two views of one scene in a folder."""
    from skimage import data

    folder = tmp_path / "photos"
    folder.mkdir()
    left, right, _ = data.stereo_motorcycle()
    for name, image in (("left_1", left), ("right", right)):
        Image.fromarray(image[100:260, 300:500]).save(folder / f"{name}.png")
    return folder


def test_files_of_extract_and_match_many(pair: Path, tmp_path: Path) -> None:
    extract_features(pair, tmp_path / "f.h5", workers=1)
    match_pairs(tmp_path / "f.h5", [("left_1.png", "right.png")], tmp_path / "m.h5", workers=1)
    found = read_collection([tmp_path / "f.h5"], matches=tmp_path / "m.h5", images=pair)
    again = match_folder(pair, workers=1)
    assert list(found.keypoints) == ["left_1.png", "right.png"]
    assert found.path("right.png") == pair / "right.png"
    for name, points in found.keypoints.items():
        assert points.image_size == (200, 160)
        for kind in ("xy", "scores", "sizes", "angles", "descriptors"):
            np.testing.assert_array_equal(
                getattr(points, kind), getattr(again.keypoints[name], kind)
            )

    direct = PointDetector().detect(pair / "right.png")
    np.testing.assert_allclose(found.keypoints["right.png"].xy, direct.xy)
    np.testing.assert_allclose(found.keypoints["right.png"].sizes, direct.sizes, rtol=1e-6)
    ((names, matches),) = found.matches.items()
    assert names == ("left_1.png", "right.png")
    assert len(matches) > 50
    np.testing.assert_array_equal(matches.rows, again.matches[names].rows)


def test_files_of_detect_and_match(pair: Path, tmp_path: Path) -> None:
    matches = match_images(pair / "left_1.png", pair / "right.png", mutual=True)
    save_matches(matches, tmp_path / "left_1_right_matches.npz")
    save_keypoints(matches.keypoints0, tmp_path / "left_1.npz")
    files = [tmp_path / "left_1.npz", tmp_path / "left_1_right_matches.npz"]
    found = read_collection(files, images=pair)
    assert set(found.keypoints) == {"left_1.png", "right.png"}
    ((names, rows),) = ((names, each.rows) for names, each in found.matches.items())
    assert names == ("left_1.png", "right.png")
    kept = matches.inliers & (matches.indices0 >= 0) & (matches.indices1 >= 0)
    assert 0.5 * np.count_nonzero(kept) < len(rows) <= np.count_nonzero(kept)
    expected = set(
        zip(matches.indices0[kept].tolist(), matches.indices1[kept].tolist(), strict=True)
    )
    assert {tuple(row) for row in rows.tolist()} <= expected
    with pytest.raises(OptionError):
        read_collection(files)
    (tmp_path / "a_b_matches.npz").write_bytes(files[1].read_bytes())
    assert set(read_collection([tmp_path / "a_b_matches.npz"]).keypoints) == {"a", "b"}
    save_keypoints(matches.keypoints0[:5], tmp_path / "left_1.npz")
    with pytest.raises(DeepDetectError):
        read_collection(files, images=pair)


def test_names_with_folders_and_what_does_not_fit(tmp_path: Path) -> None:
    import h5py

    rng = np.random.default_rng(0)
    with h5py.File(tmp_path / "f.h5", "w") as file:  # as hloc writes it: half precision
        for name in ("db/1.jpg", "db/2.jpg"):
            file[f"{name}/keypoints"] = rng.uniform(0, 99, (5, 2)).astype(np.float16)
            file[f"{name}/descriptors"] = rng.random((256, 5)).astype(np.float16)
            file[f"{name}/scores"] = rng.random(5).astype(np.float16)
            file[f"{name}/image_size"] = np.array([120, 100])
    with h5py.File(tmp_path / "m.h5", "w") as file:
        file["db-1.jpg/db-2.jpg/matches0"] = np.array([-1, 3, -1, 0, -1], np.int16)
        file["db-1.jpg/db-2.jpg/matching_scores0"] = np.array([0, 0.5, 0, 0.75, 0], np.float16)
    found = read_collection([tmp_path / "f.h5"], matches=tmp_path / "m.h5")
    ((pair, matches),) = found.matches.items()
    assert pair == ("db/1.jpg", "db/2.jpg")
    assert matches.rows.tolist() == [[1, 3], [3, 0]]
    assert matches.scores.tolist() == [0.5, 0.75]
    assert found.keypoints["db/1.jpg"].descriptors.shape == (5, 256)
    assert found.keypoints["db/1.jpg"].sizes is None
    with h5py.File(tmp_path / "m.h5", "a") as file:
        file["db-1.jpg/db-9.jpg/matches0"] = np.array([-1, 3, -1, 0, -1], np.int16)
    for arguments in (
        {"files": [tmp_path / "f.h5"], "matches": tmp_path / "m.h5"},
        {"files": [tmp_path / "m.h5"]},
        {"files": [tmp_path / "f.h5"], "matches": tmp_path / "f.h5"},
        {"files": [tmp_path / "none.h5"]},
        {"files": [tmp_path / "f.h5", tmp_path / "a.npz"]},
        {"files": []},
    ):
        with pytest.raises(DeepDetectError):
            read_collection(**arguments)


def _write_hloc_files(folder: Path, count: int) -> None:
    """Write features of two images at the top, and matches of `count` keypoints of the first."""
    import h5py

    with h5py.File(folder / "f.h5", "w") as file:
        for name in ("1.jpg", "2.jpg"):
            file[f"{name}/keypoints"] = np.arange(10, dtype=np.float32).reshape(5, 2)
            file[f"{name}/image_size"] = np.array([120, 100])
    with h5py.File(folder / "m.h5", "w") as file:
        file["1.jpg/2.jpg/matches0"] = np.arange(count, dtype=np.int32) % 5


@pytest.mark.parametrize("count", [3, 7])
def test_matches_of_other_features_are_refused(tmp_path: Path, count: int) -> None:
    _write_hloc_files(tmp_path, count)
    with pytest.raises(DeepDetectError, match=r"1\.jpg"):
        read_collection([tmp_path / "f.h5"], matches=tmp_path / "m.h5")


def test_a_pair_both_ways_round_is_one_pair(tmp_path: Path) -> None:
    """COLMAP's database has room for one of them only."""
    import h5py

    _write_hloc_files(tmp_path, 5)
    with h5py.File(tmp_path / "m.h5", "w") as file:
        file["1.jpg/2.jpg/matches0"] = np.array([1, -1, -1, -1, 2])
        file["1.jpg/2.jpg/matching_scores0"] = np.array([0.5, 0, 0, 0, 0.5])
        file["2.jpg/1.jpg/matches0"] = np.array([-1, 0, 3, -1, -1])
        file["2.jpg/1.jpg/matching_scores0"] = np.array([0, 0.5, 0.9, 0, 0])
    found = read_collection([tmp_path / "f.h5"], matches=tmp_path / "m.h5")
    ((pair, matches),) = found.matches.items()
    assert pair == ("1.jpg", "2.jpg")
    assert matches.rows.tolist() == [[0, 1], [3, 2]]  # the better one of keypoint 2's two


def test_the_folder_of_other_photographs_is_refused(tmp_path: Path) -> None:
    _write_hloc_files(tmp_path, 5)
    (tmp_path / "photos").mkdir()
    for folder in ("photos", "none"):
        with pytest.raises(OptionError):
            read_collection([tmp_path / "f.h5"], images=tmp_path / folder)
    (tmp_path / "photos" / "2.jpg").write_bytes(b"")
    assert read_collection([tmp_path / "f.h5"], images=tmp_path / "photos").path("1.jpg") is None


def test_a_bad_photograph_does_not_stop_the_others(pair: Path) -> None:
    (pair / "middle.png").write_bytes(b"no image")
    found = match_folder(pair, PointDetector(300), pairs="sequential:1", workers=1)
    assert list(found.keypoints) == ["left_1.png", "right.png"]
    assert list(found.matches) == [("left_1.png", "right.png")]  # the next one that can be read
    (failure,) = found.failures
    assert "middle.png" in failure
    pairs = [("left_1.png", "right.png"), ("middle.png", "right.png"), ("right.png", "typo.png")]
    named = match_folder(pair, PointDetector(300), pairs=pairs, workers=1)
    assert list(named.matches) == pairs[:1]
    assert len(named.failures) == 2
    for name in ("left_1.png", "right.png"):
        (pair / name).write_bytes(b"no image")
    with pytest.raises(BatchError):
        match_folder(pair, workers=1)


def test_pairs_of_a_folder(pair: Path) -> None:
    one = match_folder(pair, PointDetector(100), pairs="sequential:1", workers=1)
    assert list(one.matches) == [("left_1.png", "right.png")]
    assert max(len(points) for points in one.keypoints.values()) == 100
    with pytest.raises(DeepDetectError):
        match_folder(pair, pairs="sequential")
