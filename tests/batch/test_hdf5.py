from __future__ import annotations

import os
import weakref
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepdetect import DeepDetectError, OptionError
from deepdetect.batch import BatchReport, hdf5
from deepdetect.batch.hdf5 import Group, Item, fill_file, open_hdf5, state_of, write_groups


def group(name: str, value: int) -> Group:
    return Group(name, {"numbers": np.full(3, value, np.int32)}, (value,))


def make(items: Sequence[Item], counts: dict[str, int], failures: list[str]) -> Iterator[Group]:
    for name, (state,) in items:
        if state < 0:
            failures.append(name)
        else:
            counts[name] = 3
            yield group(name, state)


def fill(
    path: Path, settings: Mapping[str, Any] = {}, overwrite: bool = False, **states: int
) -> BatchReport:
    """Fill a file with groups of these states; those whose names begin with "other" stay."""
    return fill_file(
        path,
        settings,
        {name: {name: (state,)} for name, state in states.items()},
        make,
        of="numbers",
        others_stay=lambda name: name.startswith("other"),
        engine="processes",
        workers=1,
        overwrite=overwrite,
        quiet=True,
    )


def values(path: Path) -> dict[str, int]:
    """Return the number in each group of a file, which has nothing else."""
    with open_hdf5(path) as file:
        return {name: int(each["numbers"][0]) for name, each in hdf5._leaves(file)}


@pytest.fixture(autouse=True)
def _h5py() -> None:
    pytest.importorskip("h5py", reason="needs h5py")


def interrupted(path: Path, monkeypatch: pytest.MonkeyPatch, **states: int) -> None:
    """Fill the shards of a file that is not written."""

    def stop(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(hdf5, "_copy_groups", stop)
        with pytest.raises(DeepDetectError):
            fill(path, **states)


def test_shards_become_one_file(tmp_path: Path) -> None:
    path = tmp_path / "out.h5"
    report = fill(path, {"a": 1}, **{"x/2": 3, "x/1": 1, "y": 2, "z": -1})
    assert report == BatchReport(path, {"x/1": 3, "x/2": 3, "y": 3}, 0, ("z",), "numbers")
    assert values(path) == {"x/1": 1, "x/2": 3, "y": 2}
    assert list(tmp_path.iterdir()) == [path]
    with open_hdf5(path) as file:
        assert state_of(file["x/2"]) == (3,)
        assert file.attrs["deepdetect"] == '{"a": 1}'


def test_what_is_done_is_known_by_its_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "out.h5"
    fill(path, x=1, other=1)
    before = path.read_bytes()
    interrupted(path, monkeypatch, x=1, y=1, z=1)
    assert path.read_bytes() == before
    report = fill(path, x=1, y=1, z=2)
    assert (report.counts, report.skipped) == ({"z": 3}, 2)
    assert values(path) == {"other": 1, "x": 1, "y": 1, "z": 2}
    assert list(tmp_path.iterdir()) == [path]
    written = path.stat().st_mtime_ns
    assert fill(path, x=1, y=1, z=2).skipped == 3
    assert path.stat().st_mtime_ns == written


def test_newer_groups_take_the_place_of_older_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "out.h5"
    fill(path, x=1)
    interrupted(path, monkeypatch, x=2)
    (shard,) = tmp_path.glob("*.shards/*/*.h5")
    write_groups(shard.with_name("older.h5"), [group("x", 3)])
    os.utime(shard.with_name("older.h5"), (1, 1))
    assert fill(path, x=2).skipped == 1
    assert values(path) == {"x": 2}


def test_groups_that_are_not_wanted_or_cannot_be_made_go(tmp_path: Path) -> None:
    path = tmp_path / "out.h5"
    fill(path, **{"x": 1, "y/1": 1, "y/2": 1, "other": 1})
    fill(path, **{"x": 1, "y/2": -1})
    assert values(path) == {"other": 1, "x": 1}


def test_a_full_disk_is_one_sentence(tmp_path: Path) -> None:
    resource = pytest.importorskip("resource")
    path = tmp_path / "out.h5"
    large = [Group(name, {"numbers": np.zeros(20_000)}, (1,)) for name in "abc"]
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, limits[1]))
    try:
        with pytest.raises(DeepDetectError, match=r"out\.h5"):
            write_groups(path, large)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(tmp_path.iterdir()) == []


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


def test_files_of_others_are_not_replaced(tmp_path: Path) -> None:
    import h5py

    path = tmp_path / "out.h5"
    with h5py.File(path, "w") as file:
        file.create_group("x")
    with pytest.raises(OptionError):
        fill(path, x=1)
    with h5py.File(path, "w") as file:
        file.attrs[hdf5.SETTINGS] = '{"ratio'
    with pytest.raises(DeepDetectError):
        fill(path, x=1)
    path.write_bytes(b"no HDF5")
    with pytest.raises(DeepDetectError):
        fill(path, x=1)
    with pytest.raises(DeepDetectError), open_hdf5(tmp_path / "no.h5"):
        pass


def test_other_settings_are_refused_and_their_shards_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "out.h5"
    interrupted(path, monkeypatch, x=1)
    settings = {"ratio": 0.8, "same": (1,)}
    assert fill(path, settings, x=1).skipped == 0
    assert fill(path, {"ratio": 0.8, "same": [1]}, x=1).skipped == 1
    settings["ratio"] = 0.9
    with pytest.raises(OptionError, match="`ratio`"):
        fill(path, settings, x=1)
    fill(path, settings, overwrite=True, y=2)
    assert values(path) == {"y": 2}
    assert list(tmp_path.iterdir()) == [path]
