from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from deepdetect import DeepDetectError, OptionError, PointDetector, match_features
from deepdetect.batch import PairMatchingOptions, extract_features, match_pairs
from deepdetect.batch.extraction import read_keypoints
from deepdetect.batch.hdf5 import open_hdf5
from deepdetect.batch.pair_list import pair_name, read_pairs, write_pairs
from deepdetect.batch.pair_matching import match_group

PAIR = ("a/00.png", "b/01.png")


@pytest.fixture(autouse=True)
def _h5py() -> None:
    pytest.importorskip("h5py", reason="needs h5py")


@pytest.fixture
def features(collection: Callable[..., Path], tmp_path: Path) -> Path:
    """Features of five crops, 8 px from one to the next."""
    path = tmp_path / "features.h5"
    few = PointDetector(300)
    extract_features(collection(5), path, few, workers=1)
    return path


def find_pair(file, name0: str, name1: str) -> tuple[str, bool]:
    """Look a pair up as hloc does (hloc/utils/io.py)."""
    for names, reverse in (((name0, name1), False), ((name1, name0), True)):
        pair = "/".join(name.replace("/", "-") for name in names)
        if pair in file:
            return pair, reverse
    raise ValueError(f"could not find pair {(name0, name1)}")


def test_the_layout_is_that_of_hloc(features: Path, tmp_path: Path) -> None:
    import h5py

    report = match_pairs(features, [PAIR], tmp_path / "m.h5", workers=1)
    with h5py.File(features) as file:
        points0, points1 = (file[name]["keypoints"][()] for name in PAIR)
    with h5py.File(tmp_path / "m.h5", "r", libver="latest") as file:
        assert find_pair(file, *PAIR) == ("a-00.png/b-01.png", False)
        assert find_pair(file, *PAIR[::-1]) == ("a-00.png/b-01.png", True)
        stored = file["a-00.png/b-01.png"]
        matches, scores = stored["matches0"][()], stored["matching_scores0"][()]
    assert (matches.shape, matches.dtype) == ((len(points0),), np.int32)
    assert (scores.shape, scores.dtype) == ((len(points0),), np.float32)
    rows = np.flatnonzero(matches != -1)
    assert report.counts == {PAIR: len(rows)}
    assert (scores[rows] > 0).all()
    assert (scores[matches == -1] == 0).all()
    assert len(set(matches[rows])) == len(rows)
    # The second crop begins 8 px further right.
    errors = np.linalg.norm(points0[rows] - points1[matches[rows]] - [8, 0], axis=1)
    assert len(rows) > 100
    assert (errors < 1).mean() > 0.9


def test_what_is_done_is_skipped(features: Path, tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "m.h5"
    assert match_pairs(features, [PAIR], path, workers=1).skipped == 0
    more = [PAIR[::-1], ("b/01.png", "a/02.png")]
    report = match_pairs(features, more, path, workers=1)
    assert (list(report.counts), report.skipped) == ([more[1]], 1)
    with pytest.raises(OptionError, match="`ratio`"):
        match_pairs(features, more, path, options=PairMatchingOptions(ratio=0.7))
    monkeypatch.setattr("shutil.rmtree", lambda path: None)  # the shards stay
    report = match_pairs(features, more, path, workers=1, overwrite=True)
    assert len(report.counts) == 2
    match_pairs(features, [PAIR], path, workers=1, overwrite=True)
    with open_hdf5(path) as file, pytest.raises(ValueError, match="could not find"):
        find_pair(file, *more[1])


def test_features_that_have_changed_are_matched_again(
    collection: Callable[..., Path], features: Path, tmp_path: Path
) -> None:
    path, pairs = tmp_path / "m.h5", [PAIR, ("b/01.png", "a/02.png")]
    match_pairs(features, pairs, path, workers=1)
    folder = tmp_path / "photos"
    (folder / "a/00.png").write_bytes((folder / "a/04.png").read_bytes())
    extract_features(folder, features, PointDetector(300), workers=1)
    report = match_pairs(features, pairs, path, workers=1)
    assert (list(report.counts), report.skipped) == ([PAIR], 1)
    fewer = PointDetector(100)
    extract_features(folder, features, fewer, workers=1, overwrite=True)
    with pytest.raises(OptionError, match="`features`"):
        match_pairs(features, pairs, path, workers=1)


def test_pairs_without_features_do_not_stop_the_others(features: Path, tmp_path: Path) -> None:
    pairs = [("a/00.png", "no.png"), PAIR, ("a-00.png", "no.png")]
    report = match_pairs(features, pairs, tmp_path / "m.h5", workers=1)
    assert list(report.counts) == [PAIR]
    assert len(report.failures) == 2


def test_two_pairs_of_one_name_are_not_mixed_up(features: Path, tmp_path: Path) -> None:
    import h5py

    with h5py.File(features, "r+") as file:
        file.copy("a/00.png", file, name="a-00.png")
    pairs = [PAIR, ("a-00.png", "b/01.png")]
    report = match_pairs(features, pairs, tmp_path / "m.h5", workers=1)
    assert list(report.counts) == [PAIR]
    assert len(report.failures) == 1


def test_features_of_other_programs(tmp_path: Path) -> None:
    """As SuperPoint's: float16, negative numbers, 256 of them, and no attributes of ours."""
    import h5py

    generator = np.random.default_rng(0)
    descriptors = generator.normal(size=(256, 40))
    descriptors /= np.linalg.norm(descriptors, axis=0)
    order = generator.permutation(40)
    with h5py.File(tmp_path / "f.h5", "w") as file:
        for name, chosen in (("x.jpg", np.arange(40)), ("y.jpg", order)):
            group = file.create_group(name)
            group["keypoints"] = generator.uniform(0, 99, (40, 2)).astype(np.float16)
            group["descriptors"] = descriptors[:, chosen].astype(np.float16)
    match_pairs(tmp_path / "f.h5", [("x.jpg", "y.jpg")], tmp_path / "m.h5", workers=1)
    with h5py.File(tmp_path / "m.h5") as file:
        np.testing.assert_array_equal(order[file["x.jpg/y.jpg/matches0"][()]], np.arange(40))


def test_verification_keeps_what_agrees(features: Path, tmp_path: Path) -> None:
    import h5py

    loose = PairMatchingOptions(ratio=1, mutual=False)
    verified = PairMatchingOptions(ratio=1, mutual=False, verify="homography")
    found = {}
    for name, options in (("all", loose), ("kept", verified)):
        match_pairs(features, [PAIR], tmp_path / f"{name}.h5", options=options, workers=1)
        with h5py.File(tmp_path / f"{name}.h5") as file:
            found[name] = file[pair_name(*PAIR)]["matches0"][()]
    kept = found["kept"] >= 0
    np.testing.assert_array_equal(found["kept"][kept], found["all"][kept])
    assert 50 < kept.sum() < (found["all"] >= 0).sum()
    with h5py.File(features) as file:
        points0, points1 = (file[name]["keypoints"][()] for name in PAIR)
    moved = points0[kept] - points1[found["kept"][kept]] - [8, 0]
    assert (np.linalg.norm(moved, axis=1) < 2).all()


@pytest.mark.parametrize("filter_by", ["ratio", "neighbours"])
def test_matches_are_filtered_as_those_of_two_images(
    features: Path, tmp_path: Path, filter_by: str
) -> None:
    import h5py

    how = PairMatchingOptions(filter_by=filter_by)
    match_pairs(features, [PAIR], tmp_path / "m.h5", options=how, workers=1)
    with open_hdf5(features) as file:
        both = [read_keypoints(file, name) for name in PAIR]
    expected = match_features(*both, filter_by=filter_by)
    with h5py.File(tmp_path / "m.h5") as file:
        found = file[pair_name(*PAIR)]["matches0"][()]
    np.testing.assert_array_equal(np.flatnonzero(found >= 0), np.sort(expected.indices0))
    np.testing.assert_array_equal(found[expected.indices0], expected.indices1)
    assert len(expected) > 200


def test_keypoints_that_neighbours_do_not_suit_are_refused_at_once(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    whole = generator.uniform(0, 99, (40, 2)), generator.normal(size=(8, 40))
    write_foreign(tmp_path / "f.h5", a=whole, b=whole)
    how = PairMatchingOptions(filter_by="neighbours")
    with pytest.raises(OptionError, match="'ratio'"):
        match_pairs(tmp_path / "f.h5", "exhaustive", tmp_path / "m.h5", options=how, workers=1)
    assert not (tmp_path / "m.h5").exists()


def test_more_keypoints_than_int16_holds() -> None:
    """hloc's own int16 would end at 32,767."""
    rows = np.array([[0, 39_999], [1, 39_998]])
    group = match_group(("a", "b"), 2, rows, np.ones(2, np.float32))
    assert group.arrays["matches0"].tolist() == [39_999, 39_998]


def write_foreign(path: Path, **images: tuple[np.ndarray, np.ndarray]) -> None:
    """Write keypoints and descriptors of images as hloc does."""
    import h5py

    with h5py.File(path, "w") as file:
        for name, (keypoints, descriptors) in images.items():
            file[f"{name}/keypoints"], file[f"{name}/descriptors"] = keypoints, descriptors


def test_features_of_other_programs_that_have_changed(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    features = {
        name: (generator.uniform(0, 99, (40, 2)), generator.normal(size=(8, 40))) for name in "xyz"
    }
    path, pairs = tmp_path / "f.h5", [("x", "y"), ("y", "z")]
    write_foreign(path, **features)
    match_pairs(path, pairs, tmp_path / "m.h5", workers=1)
    write_foreign(path, **features)
    assert match_pairs(path, pairs, tmp_path / "m.h5", workers=1).skipped == 2
    features["x"] = features["x"][0], features["x"][1][:, ::-1]
    write_foreign(path, **features)
    report = match_pairs(path, pairs, tmp_path / "m.h5", workers=1)
    assert (list(report.counts), report.skipped) == ([("x", "y")], 1)


def test_features_that_do_not_fit_do_not_stop_the_others(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    whole = generator.uniform(0, 99, (40, 2)), generator.normal(size=(8, 40))
    write_foreign(
        tmp_path / "f.h5",
        good=whole,
        same=whole,
        wide=(whole[0], generator.normal(size=(9, 40))),
        few=(whole[0], whole[1][:, :20]),
        flat=(whole[0][:, 0], whole[1]),
        unknown=(np.where(np.arange(80).reshape(40, 2) == 7, np.nan, whole[0]), whole[1]),
    )
    others = ("same", "wide", "few", "flat", "unknown", "same/keypoints")
    pairs = [("good", name) for name in others]
    report = match_pairs(tmp_path / "f.h5", pairs, tmp_path / "m.h5", workers=1)
    assert report.counts == {("good", "same"): 40}
    assert {failure.split(": ")[0] for failure in report.failures} == {
        f"good {name}" for name in others[1:]
    }


@pytest.mark.parametrize("pairs", [["a.jpg"], ["ab"], [("a", "b", "c")], [("a", "a")], [("a", "")]])
def test_wrong_pairs_from_python(pairs: object, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="`pairs`"):
        match_pairs(tmp_path / "f.h5", pairs, tmp_path / "m.h5")


def test_lists_of_pairs(tmp_path: Path) -> None:
    path = tmp_path / "pairs.txt"
    path.write_text("a.jpg b.jpg\n\nb.jpg a.jpg\na.jpg b.jpg\nwith blank.jpg\tc d.jpg\n")
    pairs = [("a.jpg", "b.jpg"), ("with blank.jpg", "c d.jpg")]
    assert read_pairs(path) == pairs
    write_pairs(path, pairs)
    assert read_pairs(path) == pairs
    write_pairs(path, pairs[:1])
    assert path.read_text() == "a.jpg b.jpg\n"


@pytest.mark.parametrize(
    "text", ["a.jpg b.jpg\na.jpg\n", "a.jpg b.jpg c.jpg\n", "a.jpg a.jpg\n", "\n", None]
)
def test_wrong_lists_of_pairs(text: str | None, tmp_path: Path) -> None:
    path = tmp_path / "pairs.txt"
    if text is not None:
        path.write_text(text)
    with pytest.raises(DeepDetectError, match=path.name):
        read_pairs(path)


@pytest.mark.parametrize(
    "values",
    [
        {"ratio": 1.5},
        {"ratio": 0},
        {"matcher": "hamming"},
        {"filter_by": "neighbors"},
        {"filter_by": "neighbours", "ratio": 0.8},
        {"verify": "essential"},
    ],
)
def test_wrong_options(values: dict) -> None:
    with pytest.raises(OptionError):
        PairMatchingOptions(**values)


def test_matches_of_features_that_are_gone_go_too(features: Path, tmp_path: Path) -> None:
    import h5py

    path = tmp_path / "matches.h5"
    match_pairs(features, [PAIR], path, workers=1)
    less = tmp_path / "less.h5"
    shutil.copyfile(features, less)
    with h5py.File(less, "r+") as file:
        del file[PAIR[1]]
    report = match_pairs(less, [PAIR], path, workers=1)
    assert (report.counts, len(report.failures)) == ({}, 1)
    with h5py.File(path) as file:
        assert pair_name(*PAIR) not in file


def test_damaged_features_do_not_stop_the_others(tmp_path: Path) -> None:
    import h5py

    generator = np.random.default_rng(0)
    whole = generator.uniform(0, 99, (40, 2)), generator.normal(size=(8, 40))
    path = tmp_path / "f.h5"
    write_foreign(path, good=whole, same=whole)
    with h5py.File(path, "r+") as file:  # a file with checksums knows that it is damaged
        file.create_dataset("bad/descriptors", data=whole[1])
        stored = file.create_dataset(
            "bad/keypoints", data=whole[0], chunks=(40, 2), fletcher32=True
        )
        stored.parent.attrs["source_state"] = [1]
        at = stored.id.get_chunk_info(0).byte_offset
    content = bytearray(path.read_bytes())
    content[at] ^= 1
    path.write_bytes(content)
    report = match_pairs(path, [("good", "bad"), ("good", "same")], tmp_path / "m.h5", workers=1)
    assert report.counts == {("good", "same"): 40}
    (failure,) = report.failures
    assert failure.startswith("good bad: ")
