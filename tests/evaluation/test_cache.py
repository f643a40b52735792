from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from deepdetect import DeepDetectError
from deepdetect.evaluation.cache import (
    STAGES,
    StageCache,
    file_digest,
    matrix_digest,
    stage_versions,
)

ARRAYS = {
    "rows": np.arange(50, dtype=np.int16),
    "values": np.random.default_rng(0).random(20),
    "one": np.array(3),
}


class Maker:
    """Counts how often it is asked."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self) -> dict[str, np.ndarray]:
        self.calls += 1
        return ARRAYS


def assert_whole(found) -> None:
    assert set(found) == set(ARRAYS)
    for name, array in ARRAYS.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)


def only_file(folder: Path) -> Path:
    (path,) = (path for path in folder.rglob("*") if path.is_file())
    return path


def test_the_second_time_nothing_is_made(tmp_path: Path) -> None:
    make = Maker()
    cache = StageCache(tmp_path)
    assert_whole(cache.get("matches", {"k": 1}, make))
    assert_whole(cache.get("matches", {"k": 1}, make))
    assert_whole(StageCache(tmp_path).get("matches", {"k": 1}, make))
    assert (make.calls, cache.made) == (1, 1)


def test_the_order_of_the_key_plays_no_part(tmp_path: Path) -> None:
    make = Maker()
    cache = StageCache(tmp_path)
    cache.get("matches", {"a": 1, "b": [2, None]}, make)
    cache.get("matches", {"b": [2, None], "a": 1}, make)
    assert make.calls == 1


def test_any_change_of_the_key_or_the_stage_makes_it_anew(tmp_path: Path) -> None:
    make = Maker()
    cache = StageCache(tmp_path)
    keys = [{"k": 1}, {"k": 2}, {"k": "1"}, {"k": None}, {"k": 1, "l": 0}, {"k": [1]}, {}]
    for stage in ("matches", "keypoints"):
        for key in keys:
            cache.get(stage, key, make)
    assert make.calls == cache.made == 2 * len(keys)


def test_without_a_folder_nothing_is_kept() -> None:
    make = Maker()
    cache = StageCache(None)
    for _ in range(3):
        assert_whole(cache.get("matches", {"k": 1}, make))
    assert (make.calls, cache.made) == (3, 3)


@pytest.mark.parametrize(
    "damage",
    [
        lambda raw: b"",
        lambda raw: b"no archive",
        lambda raw: raw[: len(raw) // 2],
        lambda raw: raw[:-1],
        lambda raw: raw[len(raw) // 2 :],
        lambda raw: b"\x80\x04K\x01.",
    ],
    ids=["empty", "text", "half", "last byte", "second half", "pickle"],
)
def test_a_damaged_file_is_made_anew_and_repaired(
    tmp_path: Path, damage: Callable[[bytes], bytes]
) -> None:
    make = Maker()
    cache = StageCache(tmp_path)
    cache.get("matches", {"k": 1}, make)
    path = only_file(tmp_path)
    raw = path.read_bytes()
    path.write_bytes(damage(raw))
    assert_whole(cache.get("matches", {"k": 1}, make))
    assert make.calls == cache.made == 2
    assert_whole(cache.get("matches", {"k": 1}, make))
    assert make.calls == 2


@pytest.mark.parametrize("part", range(4))
def test_a_flipped_byte_anywhere_changes_nothing(tmp_path: Path, part: int) -> None:
    """Compressed data, names and the directory of the archive are all struck in turn."""
    cache = StageCache(tmp_path)
    cache.get("matches", {"k": 1}, Maker())
    path = only_file(tmp_path)
    raw = path.read_bytes()
    for place in range(part * len(raw) // 4, (part + 1) * len(raw) // 4, 17):
        struck = bytearray(raw)
        struck[place] ^= 0xFF
        path.write_bytes(struck)
        assert_whole(cache.get("matches", {"k": 1}, Maker()))


def test_a_result_that_fails_is_neither_kept_nor_counted(tmp_path: Path) -> None:
    def fail() -> dict[str, np.ndarray]:
        raise ValueError("no result")

    for cache in (StageCache(tmp_path), StageCache(None)):
        with pytest.raises(ValueError, match="no result"):
            cache.get("matches", {"k": 1}, fail)
        assert cache.made == 0
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
    assert_whole(StageCache(tmp_path).get("matches", {"k": 1}, Maker()))


def test_no_temporary_files_stay(tmp_path: Path) -> None:
    StageCache(tmp_path).get("matches", {"k": 1}, Maker())
    assert only_file(tmp_path).parent.name == "matches"


def test_a_folder_that_cannot_be_written_is_said(tmp_path: Path, one_line) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DeepDetectError, match="cannot write") as caught:
        StageCache(tmp_path / "file").get("matches", {"k": 1}, Maker())
    one_line(caught.value)


def test_the_digest_is_that_of_the_content(tmp_path: Path) -> None:
    for name in "ab":
        (tmp_path / name).write_bytes(b"abc")
    # The test vector of FIPS 180-2.
    expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert file_digest(tmp_path / "a") == file_digest(tmp_path / "b") == expected


def test_a_file_that_changes_while_the_program_runs_gets_another_digest(tmp_path: Path) -> None:
    path = tmp_path / "image"
    path.write_bytes(b"one")
    first = file_digest(path)
    path.write_bytes(b"another")
    os.utime(path, ns=(10**18, 10**18))
    assert file_digest(path) != first


def test_the_same_relative_path_in_another_folder_is_another_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    digests = set()
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "relative-image").write_text(name)
        monkeypatch.chdir(tmp_path / name)
        digests.add(file_digest(Path("relative-image")))
    assert len(digests) == 2


@pytest.mark.parametrize(
    ("raised", "again"),
    [("matches", ["matches", "corner_errors"]), ("keypoints", list(STAGES)[:2])],
)
def test_a_raised_version_makes_a_stage_again_and_what_is_made_from_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, raised: str, again: list[str]
) -> None:
    cache = StageCache(tmp_path)

    def made() -> list[str]:
        stages = []
        for stage in STAGES:
            before = cache.made
            cache.get(stage, {"k": 1}, Maker())
            stages += [stage] if cache.made > before else []
        return stages

    assert made() == list(STAGES)
    assert made() == []
    monkeypatch.setitem(STAGES, raised, (2, STAGES[raised][1]))
    found = made()
    assert found[: len(again)] == again
    assert "stereo" not in found
    assert all(raised in stage_versions(stage) for stage in found)


def test_other_versions_of_opencv_and_numpy_make_all_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = StageCache(tmp_path)
    for k, module in enumerate((None, cv2, np)):
        if module is not None:
            monkeypatch.setattr(module, "__version__", "0.0.0")
        cache.get("matches", {"k": 1}, Maker())
        assert cache.made == k + 1


def test_a_matrix_is_known_by_its_numbers() -> None:
    matrix = np.arange(9.0).reshape(3, 3)
    assert matrix_digest(matrix) == matrix_digest(matrix.T.copy().T)
    assert matrix_digest(matrix) == matrix_digest(matrix.astype(np.float32))
    moved = matrix.copy()
    moved[0, 2] = np.nextafter(moved[0, 2], 9)
    assert len({matrix_digest(m) for m in (matrix, matrix.T, moved)}) == 3
