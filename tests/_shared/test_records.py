from __future__ import annotations

import hashlib
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from deepdetect import OptionError
from deepdetect._shared.errors import MissingFileError
from deepdetect._shared.records import (
    Outputs,
    check_same,
    key,
    load_arrays,
    lock,
    plain,
    save_arrays,
    was_made,
)


@dataclass(frozen=True)
class Options:
    ratio: float = 0.8
    sizes: tuple[int, ...] = (1, 2)


def make(outputs: Outputs, content: bytes = b"made", **values: object) -> None:
    with outputs.writing() as notes:
        for path in outputs.paths:
            path.write_bytes(content)
        notes |= values


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "image.jpg"
    path.write_bytes(b"pixels")
    return path


def test_keys_have_known_values() -> None:
    # Another value makes all results that users have kept unknown.
    text = '["a", 1, null, {"class": "Options", "ratio": 0.8, "sizes": [1, 2]}]'
    assert key("a", 1, None, Options()) == hashlib.sha256(text.encode()).hexdigest()[:32]
    array = hashlib.sha256(b"float32(2,)" + bytes([0, 0, 0, 0, 0, 0, 0x80, 0x3F])).hexdigest()
    assert plain(np.arange(2, dtype=np.float32)) == array


def test_keys_differ_where_anything_does(source: Path) -> None:
    grid = np.arange(6, dtype=np.int32)
    values = [1, 1.0, "1", True, None, [1], [[1]], {"a": 1}, b"1", source, str(source)]
    values += [grid, grid.reshape(2, 3), grid.astype(np.int64), grid[::-1]]
    values += [Options(), Options(0.9), Options(sizes=(12,)), {"ratio": 0.8, "sizes": [1, 2]}]
    keys = [key(value) for value in values]
    assert len({*keys, key(), key(1, 2), key([1, 2])}) == len(keys) + 3
    source.write_bytes(b"others")
    assert key(source) != keys[9]


def test_equal_values_have_one_key(tmp_path: Path, source: Path) -> None:
    copy = tmp_path / "copy.jpg"
    shutil.copy(source, copy)
    os.utime(copy, (1, 1))
    assert key(source) == key(copy)
    assert key({"a": 1, "b": (2, {3, 4})}) == key({"b": [2, frozenset({4, 3})], "a": np.int64(1)})
    grid = np.arange(6.0).reshape(2, 3)
    assert key(np.asfortranarray(grid)) == key(grid)


def test_what_has_no_digest_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(TypeError):
        key(object())
    with pytest.raises(MissingFileError):
        key(tmp_path / "missing")


def test_done_work_is_found_and_anything_else_is_left_or_refused(
    tmp_path: Path, source: Path
) -> None:
    paths = [tmp_path / "out" / name for name in ("points.npz", "points.png")]
    outputs = Outputs(paths, [source], {"threshold": 0.5})
    assert outputs.find() is None
    make(outputs, keypoints=3)
    assert outputs.find() == {"keypoints": 3}
    assert Outputs(paths[:1], [source], {"threshold": 0.5}).find() == {"keypoints": 3}
    with pytest.raises(OptionError, match="`threshold`"):
        Outputs(paths, [source], {"threshold": 0.6}).find()
    assert Outputs(paths, [source], {"threshold": 0.6}, overwrite=True).find() is None
    paths[1].write_bytes(b"changed")
    with pytest.raises(OptionError):
        outputs.find()
    paths[1].unlink()
    assert outputs.find() is None
    make(outputs)
    source.write_bytes(b"another image")
    assert outputs.find() is None


def test_a_copied_folder_is_known(tmp_path: Path, source: Path) -> None:
    make(Outputs([tmp_path / "out" / "points.npz"], [source], {}), count=1)
    shutil.copytree(tmp_path / "out", tmp_path / "copy")
    copied = tmp_path / "copy" / "points.npz"
    os.utime(copied, (1, 1))
    assert Outputs([copied], [source]).find() == {"count": 1}


def test_outputs_belong_to_the_files_that_they_were_made_from(tmp_path: Path) -> None:
    first, second, output = tmp_path / "a.png", tmp_path / "b.png", tmp_path / "panorama.jpg"
    output.write_bytes(b"somebody's own")
    with pytest.raises(OptionError):
        Outputs([output], [first]).check()
    make(Outputs([output], [first], overwrite=True))
    Outputs([output], [first]).check()
    for inputs in ([second], [first, second]):
        with pytest.raises(OptionError):
            Outputs([output], inputs).check()
    make(Outputs([output], [first, second], growing=True))
    with pytest.raises(OptionError):
        Outputs([output], [second], growing=True).check()


def test_work_that_fails_leaves_no_trace(tmp_path: Path, source: Path) -> None:
    output = tmp_path / "new" / "deep" / "points.npz"
    with pytest.raises(KeyboardInterrupt), Outputs([output], [source]).writing():
        raise KeyboardInterrupt
    assert not (tmp_path / "new").exists()


def test_what_is_not_replaced_belongs_to_what_it_did(tmp_path: Path, source: Path) -> None:
    kept, replaced = tmp_path / "kept.npz", tmp_path / "replaced.npz"
    other = tmp_path / "other.jpg"
    make(Outputs([kept, replaced], [source]))

    def fail() -> None:
        with Outputs([kept, replaced], [other], overwrite=True).writing():
            replaced.write_bytes(b"of the other image")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    Outputs([kept], [source]).check()
    Outputs([replaced], [other]).check()
    assert Outputs([replaced], [other]).find() is None, "it may not be whole"


@pytest.mark.parametrize("content", [b"", b"[1]", b"{}", b"\xff"])
def test_a_damaged_record_is_none(tmp_path: Path, source: Path, content: bytes) -> None:
    outputs = Outputs([tmp_path / "points.npz"], [source])
    make(outputs)
    (tmp_path / ".deepdetect" / "points.npz.json").write_bytes(content)
    with pytest.raises(OptionError):
        outputs.find()


def test_outputs_are_known(tmp_path: Path, source: Path) -> None:
    made = tmp_path / "matches"
    with Outputs([made, tmp_path / "a.png"], [source]).writing():
        made.mkdir()
    for path in (source, tmp_path / "other" / "a.png"):
        assert not was_made(path, tmp_path)
    for path in (tmp_path / "a.png", made / "lines.png"):
        assert was_made(path, tmp_path)
    assert not was_made(made / "lines.png", made), "below a folder that is named, all is input"


def test_settings_that_differ_are_named(tmp_path: Path) -> None:
    before = {"ratio": 0.8, "seed": 0, "old": 1}
    check_same(tmp_path, before, {"ratio": 0.8, "seed": 0})
    with pytest.raises(OptionError, match=r"`new`.*`seed`"):
        check_same(tmp_path, before, {"ratio": 0.8, "seed": 1, "new": None})
    with pytest.raises(OptionError):
        check_same(tmp_path, None, {})


def test_arrays_come_back_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "arrays.npz"
    assert load_arrays(path) is None
    arrays = {"points": np.arange(6.0).reshape(2, 3), "none": np.zeros((0, 2), np.uint8)}
    save_arrays(path, arrays)
    loaded = load_arrays(path)
    assert loaded is not None
    assert loaded.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(loaded[name], array)
        assert loaded[name].dtype == array.dtype
    content = path.read_bytes()
    for length in range(0, len(content), 17):
        path.write_bytes(content[:length])
        assert load_arrays(path) is None


@pytest.mark.skipif(os.name != "posix", reason="Windows has no flock")
def test_one_at_a_time_holds_a_lock(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    for _ in range(2):
        with (
            lock(path, tmp_path),
            pytest.raises(OptionError),
            lock(path, tmp_path),
        ):
            pass
