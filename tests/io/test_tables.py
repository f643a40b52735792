from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from deepdetect import DeepDetectError, Keypoints, Matches, OptionError
from deepdetect.io.tables import load_keypoints, save_keypoints, save_matches
from deepdetect.matching.guided import Guidance


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


@pytest.mark.parametrize("model", [None, np.arange(9.0).reshape(3, 3)])
def test_matches_are_plain_arrays(tmp_path: Path, model: np.ndarray | None) -> None:
    points = keypoints(5)
    kind = "none" if model is None else "homography"
    matches = Matches(
        *(points.xy, points.xy[::-1], points.scores, model, np.arange(5) > 2, kind),
        *(points, points),
    )
    save_matches(matches, tmp_path / "m.npz")
    with np.load(tmp_path / "m.npz", allow_pickle=False) as file:
        np.testing.assert_array_equal(file["points0"], matches.points0)
        np.testing.assert_array_equal(file["points1"], matches.points1)
        np.testing.assert_array_equal(file["ratios"], matches.ratios)
        np.testing.assert_array_equal(file["inliers"], matches.inliers)
        assert file["model"].shape == ((0, 0) if model is None else (3, 3))
        assert str(file["kind"]) == kind


@pytest.mark.parametrize("kind", [None, "none", "homography", "fundamental"])
def test_what_guided_is_in_the_file(tmp_path: Path, kind: str | None) -> None:
    points = keypoints(5)
    guidance = None if kind is None else Guidance(kind, None, 0, 0, float("inf"), 0)
    matches = Matches(
        *(points.xy, points.xy, points.scores, None, np.ones(5, bool), "none", points, points),
        guidance=guidance,
    )
    save_matches(matches, tmp_path / "m.npz")
    with np.load(tmp_path / "m.npz", allow_pickle=False) as file:
        assert (file["guided"].dtype, file["guided"].shape) == (np.bool_, ())
        assert bool(file["guided"]) == matches.guided == (kind in ("homography", "fundamental"))
        assert str(file["guidance"]) == (kind or "none")
    save_matches(matches, tmp_path / "m.csv")
    assert (tmp_path / "m.csv").read_text().splitlines()[0] == "x0,y0,x1,y1,ratio,inlier"


@pytest.mark.parametrize("name", ["k.pkl", "k", "k.npy"])
def test_other_endings_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(OptionError, match=r"\.npz or \.csv"):
        save_keypoints(keypoints(1), tmp_path / name)


def test_files_without_keypoints_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    (tmp_path / "text.npz").write_text("nothing")
    np.savez(tmp_path / "pickle.npz", keypoints=np.array([{}], dtype=object), scores=[1])
    for name in ("other.npz", "text.npz", "pickle.npz", "missing.npz"):
        with pytest.raises(DeepDetectError):
            load_keypoints(tmp_path / name)


def test_logits_survive_the_round_trip(tmp_path: Path) -> None:
    points = Keypoints([[1, 2], [3.5, 4]], [1, 1], (8, 8), [17.5, 40])
    save_keypoints(points, tmp_path / "k.npz")
    found = load_keypoints(tmp_path / "k.npz")
    assert found.logits is not None
    assert found.logits.tolist() == [17.5, 40]
    assert found.best(1).xy.tolist() == [[3.5, 4]]
