from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from deepdetect import DeepDetectError, Keypoints, Matches
from deepdetect.features.matches import Evidence, Layer, TwoViewGeometry
from deepdetect.io import tables
from deepdetect.io.tables import load_keypoints, load_matches, save_keypoints, save_matches


def keypoints(count: int) -> Keypoints:
    rng = np.random.default_rng(count)
    return Keypoints(rng.random((count, 2)) * 4000, rng.random(count), (6000, 4000))


@settings(max_examples=20, deadline=None)
@given(
    xy=st.integers(0, 20).flatmap(
        lambda n: arrays(np.float32, (n, 2), elements=st.floats(0, 6000, width=32))
    )
)
def test_keypoints_survive_the_round_trip(xy: np.ndarray, tmp_path_factory) -> None:
    path = tmp_path_factory.mktemp("k") / "k.npz"
    saved = Keypoints(xy, np.linspace(0, 1, len(xy)), (6001, 33))
    save_keypoints(saved, path)
    loaded = load_keypoints(path)
    np.testing.assert_array_equal(loaded.xy, saved.xy)
    np.testing.assert_array_equal(loaded.scores, saved.scores)
    assert loaded.image_size == (6001, 33)


def test_csv_keeps_float32_positions(tmp_path: Path) -> None:
    points = Keypoints([[5999.875, 0.0625]], [0.123456], (6000, 4000))
    save_keypoints(points, tmp_path / "k.csv")
    header, row = (tmp_path / "k.csv").read_text().splitlines()
    assert header == "x,y,score"
    assert np.array_equal(np.array(row.split(","), np.float32)[:2], points.xy[0])


def matches_of(geometry: TwoViewGeometry | None = None) -> Matches:
    points = keypoints(5)
    ends = points.xy, points.xy[::-1], points.scores, np.arange(5) > 2
    return Matches(*ends, points, points[:3], geometry=geometry)


MATRIX = np.arange(9.0).reshape(3, 3)
EVIDENCE = Evidence(90, 80, -120.5, 6, 70, 10, 0.75, 0.5)
GEOMETRIES = {
    "no geometry yet": None,
    "none": TwoViewGeometry("none", evidence=Evidence(7, simulated_views=60)),
    "homography": TwoViewGeometry("homography", MATRIX, "planar", "high", EVIDENCE),
    "fundamental": TwoViewGeometry(
        "fundamental", MATRIX, "depth", "fair", EVIDENCE, (Layer("fundamental", MATRIX, 0.6),)
    ),
}


@pytest.mark.parametrize("kind", GEOMETRIES)
def test_matches_survive_the_round_trip(tmp_path: Path, kind: str) -> None:
    saved = replace(matches_of(GEOMETRIES[kind]), subpixel=kind == "fundamental")
    save_matches(saved, tmp_path / "m.npz")
    loaded = load_matches(tmp_path / "m.npz")
    for name in ("points0", "points1", "scores", "inliers", "layer"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(saved, name), err_msg=name)
    assert loaded.subpixel is saved.subpixel
    for one, other in (
        (loaded.keypoints0, saved.keypoints0),
        (loaded.keypoints1, saved.keypoints1),
    ):
        np.testing.assert_array_equal(one.xy, other.xy)
        np.testing.assert_array_equal(one.scores, other.scores)
        assert one.image_size == other.image_size
    assert loaded.success is (kind != "none")
    if saved.geometry is None:
        assert loaded.geometry is None
        return
    found, given = vars(loaded.geometry), vars(saved.geometry)
    np.testing.assert_array_equal(found.pop("matrix"), given["matrix"])
    assert vars(found.pop("evidence")) == vars(given["evidence"])
    layers = found.pop("layers"), given["layers"]
    for one, other in zip(*layers, strict=True):
        assert (one.model, one.share) == (other.model, other.share)
        np.testing.assert_array_equal(one.matrix, other.matrix)
    assert found == {name: given[name] for name in ("model", "scene", "confidence")}


def test_matches_as_csv(tmp_path: Path) -> None:
    matches = matches_of()
    save_matches(matches, tmp_path / "m.csv")
    header, *rows = (tmp_path / "m.csv").read_text().splitlines()
    assert header == "x0,y0,x1,y1,score,inlier"
    table = np.loadtxt(rows, delimiter=",")
    np.testing.assert_allclose(table[:, :2], matches.points0, rtol=1e-6)
    np.testing.assert_allclose(table[:, 4], matches.scores, rtol=1e-6)
    np.testing.assert_array_equal(table[:, 5], matches.inliers)


def test_files_of_something_else_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    (tmp_path / "text.npz").write_text("nothing")
    np.savez(tmp_path / "pickle.npz", keypoints=np.array([{}], dtype=object), scores=[1])
    for name in ("other.npz", "text.npz", "pickle.npz", "missing.npz"):
        for load in (load_keypoints, load_matches):
            with pytest.raises(DeepDetectError, match=name):
                load(tmp_path / name)


def test_all_of_keypoints_survives_the_round_trip(tmp_path: Path) -> None:
    described = np.arange(12, dtype=np.uint8).reshape(3, 4)
    points = replace(keypoints(3), logits=np.array([17.5, 40, 1], np.float32))
    for kind in ("rootsift", None):
        saved = replace(points, descriptors=described, descriptor_type=kind)
        save_keypoints(saved, tmp_path / "k.npz")
        loaded = load_keypoints(tmp_path / "k.npz")
        assert loaded.descriptor_type == kind
        assert loaded.descriptors.dtype == np.uint8
        np.testing.assert_array_equal(loaded.descriptors, described)
        np.testing.assert_array_equal(loaded.logits, points.logits)


def zipped(members: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return file.getvalue()


def npy(array: np.ndarray, **header: object) -> bytes:
    """Return the content of a npy file, whose header may be of another array."""
    file = io.BytesIO()
    stated = np.lib.format.header_data_from_array_1_0(array) | header
    np.lib.format.write_array_header_1_0(file, stated)
    return file.getvalue() + array.tobytes()


XY, SCORES = np.ones((4, 2), np.float32), np.ones(4, np.float32)
WHOLE = {
    "keypoints.npy": npy(XY),
    "scores.npy": npy(SCORES),
    "image_size.npy": npy(np.array([9, 9])),
}


def flagged(content: bytes, bit: int) -> bytes:
    """Set a flag of the first member, in its own header and in the directory."""
    changed = bytearray(content)
    changed[6] |= bit
    changed[content.index(b"PK\1\2") + 8] |= bit
    return bytes(changed)


DAMAGED = {
    "4 TB asked for": zipped(WHOLE | {"scores.npy": npy(SCORES, shape=(10**12,))}),
    "4 TB of nothing": zipped(WHOLE | {"scores.npy": npy(SCORES, shape=(10**12, 0))}),
    "less than stated": zipped(WHOLE | {"scores.npy": npy(SCORES, shape=(5,))}),
    "a negative size": zipped(WHOLE | {"scores.npy": npy(SCORES, shape=(-4,))}),
    "no size": zipped(WHOLE | {"image_size.npy": npy(np.array(9))}),
    "an infinite size": zipped(WHOLE | {"image_size.npy": npy(np.array([np.inf, 9]))}),
    "words as scores": zipped(WHOLE | {"scores.npy": npy(np.array(["a"] * 4))}),
    "a cut header": zipped(WHOLE | {"scores.npy": npy(SCORES)[:30]}),
    "no array": zipped(WHOLE | {"scores.npy": b"words"}),
    "encrypted": flagged(zipped(WHOLE), 1),
    "empty": b"",
}


@pytest.mark.parametrize("kind", DAMAGED)
def test_damaged_files_are_refused(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "k.npz"
    path.write_bytes(zipped(WHOLE, zipfile.ZIP_DEFLATED))
    assert len(load_keypoints(path)) == 4
    path.write_bytes(DAMAGED[kind])
    with pytest.raises(DeepDetectError, match=path.name):
        load_keypoints(path)


def test_every_flipped_bit_is_one_sentence_or_harmless(
    tmp_path: Path, one_line: Callable[[BaseException], str]
) -> None:
    path = tmp_path / "k.npz"
    save_keypoints(keypoints(40), path)
    content = path.read_bytes()
    refused = 0
    places = range(0, len(content), 3)
    for place in places:
        changed = bytearray(content)
        changed[place] ^= 1 << place % 8
        path.write_bytes(changed)
        try:
            load_keypoints(path)
        except DeepDetectError as error:
            one_line(error)
            refused += 1
    assert refused > len(places) / 2


def test_indices_survive_the_round_trip(tmp_path: Path) -> None:
    saved = matches_of()
    saved = Matches(**{**vars(saved), "indices0": [4, 3, 2, 1, 0], "indices1": [0, 1, 2, -1, -1]})
    save_matches(saved, tmp_path / "m.npz")
    loaded = load_matches(tmp_path / "m.npz")
    assert loaded.indices0.tolist() == [4, 3, 2, 1, 0]
    assert loaded.indices1.tolist() == [0, 1, 2, -1, -1]


def test_indices_of_no_keypoint_are_damage(tmp_path: Path) -> None:
    save_matches(matches_of(), tmp_path / "m.npz")
    with np.load(tmp_path / "m.npz") as file:
        arrays = dict(file)
    np.savez(tmp_path / "bad.npz", **{**arrays, "indices1": arrays["indices1"] + 5})
    with pytest.raises(ValueError, match="indices1"):
        load_matches(tmp_path / "bad.npz")


def test_csv_files_are_the_same_in_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    xy = np.random.default_rng(0).random((10, 2), np.float32) * 100
    points = Keypoints(xy, xy[:, 0] / 100, (100, 100), sizes=xy[:, 1])
    save_keypoints(points, tmp_path / "whole.csv")
    monkeypatch.setattr(tables, "CSV_ROWS", 3)
    save_keypoints(points, tmp_path / "blocks.csv")
    text = (tmp_path / "blocks.csv").read_text()
    assert text == (tmp_path / "whole.csv").read_text()
    assert len(text.splitlines()) == 11
    save_keypoints(Keypoints.empty((9, 9)), tmp_path / "empty.csv")
    assert (tmp_path / "empty.csv").read_text() == "x,y,score\n"
