from __future__ import annotations

import weakref
from pathlib import Path

import numpy as np
import pytest

from deepdetect import DeepDetectError, OptionError
from deepdetect.batch import hdf5
from deepdetect.batch.hdf5 import Group, ShardedWriter, open_hdf5, state_of, write_groups


def group(name: str, value: int, state: int = 1) -> Group:
    return Group(name, {"numbers": np.full(3, value, np.int32)}, (state,))


def values(path: Path) -> dict[str, int]:
    """Return the number in each group of a file, which has nothing else."""
    with open_hdf5(path) as file:
        return {name: int(each["numbers"][0]) for name, each in hdf5._leaves(file)}


@pytest.fixture(autouse=True)
def _h5py() -> None:
    pytest.importorskip("h5py", reason="needs h5py")


def test_shards_become_one_file(tmp_path: Path) -> None:
    path = tmp_path / "out.h5"
    with ShardedWriter(path, {"a": 1}).opened() as file:
        write_groups(file.shard(["x/1"]), [group("x/1", 1)])
        write_groups(file.shard(["y", "x/2"]), [group("y", 2), group("x/2", 3)])
        assert not path.exists()
        file.merge()
    assert values(path) == {"x/1": 1, "x/2": 3, "y": 2}
    assert list(tmp_path.iterdir()) == [path]
    with open_hdf5(path) as file:
        assert state_of(file["x/2"]) == (1,)
        assert file.attrs["deepdetect"] == '{"a": 1}'


def test_what_is_done_is_known_by_its_state(tmp_path: Path) -> None:
    path = tmp_path / "out.h5"
    wanted = {"x": (1,), "y": (1,), "z": (1,)}
    with ShardedWriter(path, {}).opened() as file:
        assert file.done(wanted) == set()
        write_groups(file.shard(["x"]), [group("x", 1)])
        file.merge()
    with ShardedWriter(path, {}).opened() as file:
        write_groups(file.shard(["y"]), [group("y", 1)])
    with ShardedWriter(path, {}).opened() as file:  # as after a kill
        assert file.done(wanted) == {"x", "y"}
        assert file.done({"x": (2,), "y": (2,)}) == set()


def test_newer_groups_take_the_place_of_older_ones(tmp_path: Path) -> None:
    path = tmp_path / "out.h5"
    for value in (1, 2):
        with ShardedWriter(path, {}).opened() as file:
            write_groups(file.shard(["x"]), [group("x", value, value)])
            file.merge()
    with ShardedWriter(path, {}).opened() as file:
        for value, names in ((3, ["x"]), (4, ["x", "y"]), (5, ["a", "x"])):
            write_groups(file.shard(names), [group("x", value, value)])
        file.merge()
    assert values(path) == {"x": 5}


def test_a_merge_that_fails_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "out.h5"
    with ShardedWriter(path, {}).opened() as file:
        write_groups(file.shard(["old"]), [group("old", 0)])
        file.merge()
    before = path.read_bytes()
    copy = hdf5._copy_groups
    calls: list[Path] = []

    def fail_at_the_second(shard: Path, merged: object, stays: object) -> None:
        calls.append(shard)
        if len(calls) == 2:
            raise OSError(28, "No space left on device")
        copy(shard, merged, stays)

    monkeypatch.setattr(hdf5, "_copy_groups", fail_at_the_second)
    with ShardedWriter(path, {}).opened() as file:
        for name in "xyz":
            write_groups(file.shard([name]), [group(name, ord(name))])
        with pytest.raises(DeepDetectError, match="No space left on device"):
            file.merge()
    assert path.read_bytes() == before
    with ShardedWriter(path, {}).opened() as file:
        assert file.done(dict.fromkeys("xyz", (1,))) == {"x", "y", "z"}
        file.merge()
    assert values(path) == {"old": 0, "x": 120, "y": 121, "z": 122}
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk_is_one_sentence(tmp_path: Path) -> None:
    resource = pytest.importorskip("resource")
    path = tmp_path / "out.h5"
    large = [Group(name, {"numbers": np.zeros(20_000)}, (1,)) for name in "abc"]
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    with ShardedWriter(path, {}).opened() as file:
        for each in large:
            write_groups(file.shard([each.name]), [each])
        resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, limits[1]))
        try:
            with pytest.raises(DeepDetectError, match=r"cannot write .*out.h5 \(File too large\)"):
                file.merge()
            with pytest.raises(DeepDetectError, match=r"\(File too large\): free some space"):
                write_groups(file.shard(["all"]), large)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert len(file._shard_files()) == 3
    assert [each.name for each in tmp_path.iterdir()] == ["out.h5.shards"]


def test_a_shard_is_whole_or_not_there(tmp_path: Path) -> None:
    def groups():
        yield group("x", 1)
        raise DeepDetectError("no")

    with pytest.raises(DeepDetectError, match="no"):
        write_groups(tmp_path / "part.h5", groups())
    write_groups(tmp_path / "part.h5", [])
    assert list(tmp_path.iterdir()) == []


def test_groups_are_written_one_by_one(tmp_path: Path) -> None:
    """The memory does not grow with their number."""
    made: list[weakref.ref] = []

    def groups():
        for k in range(9):
            each = group(f"{k}", k)
            made.append(weakref.ref(each.arrays["numbers"]))
            yield each
            assert sum(reference() is not None for reference in made) <= 3

    write_groups(tmp_path / "part.h5", groups())
    assert values(tmp_path / "part.h5") == {f"{k}": k for k in range(9)}


@pytest.mark.parametrize("count", [0, 1, 255, 256, 600, 5000])
def test_shards_are_small_and_hold_everything_once(count: int, tmp_path: Path) -> None:
    items = [(number, (1,)) for number in range(count)]
    paths, shards = [], []
    for path, shard in ShardedWriter(tmp_path / "out.h5", {}).tasks(items, 16):
        paths.append(path)
        shards.append(shard)
    assert [item for shard in shards for item in shard] == items
    assert all(1 <= len(shard) <= 16 for shard in shards)
    assert len(set(paths)) == len(shards) >= min(count, 256)


def test_files_of_others_are_not_replaced(tmp_path: Path) -> None:
    import h5py

    path = tmp_path / "out.h5"
    with h5py.File(path, "w") as file:
        file.create_group("x")
    with (
        pytest.raises(OptionError, match="written by something else"),
        ShardedWriter(path, {}).opened(),
    ):
        pass
    path.write_bytes(b"no HDF5")
    with pytest.raises(DeepDetectError, match="is no HDF5 file"), ShardedWriter(path, {}).opened():
        pass
    with pytest.raises(DeepDetectError, match="there is no file"), open_hdf5(tmp_path / "no.h5"):
        pass


def test_other_settings_are_refused_and_their_shards_not_used(tmp_path: Path) -> None:
    path = tmp_path / "out.h5"
    for ratio in (0.8, 0.9):
        with ShardedWriter(path, {"ratio": ratio, "same": (1,)}).opened() as file:
            assert file.done({"x": (1,)}) == set()
            write_groups(file.shard(["x"]), [group("x", round(10 * ratio))])
    with ShardedWriter(path, {"ratio": 0.8, "same": [1]}).opened() as file:
        assert file.done({"x": (1,)}) == {"x"}
        file.merge()
    assert values(path) == {"x": 8}
    other = {"ratio": 0.9, "same": (1,)}
    with (
        pytest.raises(OptionError, match=r"other settings \(`ratio`\).*--overwrite"),
        ShardedWriter(path, other).opened(),
    ):
        pass
    with ShardedWriter(path, other, overwrite=True).opened() as file:
        write_groups(file.shard(["y"]), [group("y", 2)])
        file.merge()
    assert values(path) == {"y": 2}
    assert list(tmp_path.iterdir()) == [path]


def test_only_named_groups_stay(tmp_path: Path) -> None:
    path = tmp_path / "out.h5"
    with ShardedWriter(path, {}).opened() as file:
        write_groups(file.shard(["x", "y"]), [group("x", 1), group("y/1", 1), group("y/2", 1)])
        file.merge(stays={"x", "y/1", "y/2"}.__contains__)
    with ShardedWriter(path, {}).opened() as file:
        file.merge(stays={"x", "y/2"}.__contains__)
    assert values(path) == {"x": 1, "y/2": 1}
    with ShardedWriter(path, {}).opened() as file:
        write_groups(file.shard(["z"]), [group("y/2", 2), group("z", 2)])
        file.merge(stays={"y/2"}.__contains__)
    assert values(path) == {"y/2": 2}
