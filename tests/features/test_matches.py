from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect import Keypoints, Matches, OptionError
from deepdetect.features.keypoints import nearest_keypoints
from deepdetect.features.matches import TwoViewGeometry
from deepdetect.geometry.estimation import MAX_LOG10_NFA, Geometry

GRID = np.stack(np.meshgrid(np.arange(0, 40, 4), np.arange(0, 32, 4)), -1).reshape(-1, 2)
KEYPOINTS = Keypoints(GRID, np.linspace(0, 1, len(GRID)), (40, 32))


def matches_of(first: Any, second: Any, scores: Any = None, **changes: Any) -> Matches:
    """Matches of keypoints by their rows."""
    count = len(first)
    values = {
        "points0": KEYPOINTS.xy[list(first)],
        "points1": KEYPOINTS.xy[list(second)],
        "scores": np.linspace(1, 0.5, count) if scores is None else scores,
        "inliers": np.arange(count) % 2 == 0,
        "keypoints0": KEYPOINTS,
        "keypoints1": KEYPOINTS,
        "seconds": {"matching": 0.5},
        "geometry": TwoViewGeometry("homography", np.eye(3), "planar", "high"),
        "indices0": np.array(first, np.int64),
        "indices1": np.array(second, np.int64),
    }
    return Matches(**{**values, **changes})


MATCHES = matches_of([5, 6, 7, 8], [1, 2, 3, 4])


@pytest.mark.parametrize(
    ("index", "kept"),
    [
        (slice(None, 2), [0, 1]),
        (slice(None, None, -1), [3, 2, 1, 0]),
        ([2, 0], [2, 0]),
        ([], []),
        (np.array([1, 1]), [1, 1]),
        (np.array([True, False, False, True]), [0, 3]),
        (np.zeros(4, bool), []),
        (1, [1]),
        (-1, [3]),
        (np.int64(2), [2]),
    ],
)
def test_indexing_is_that_of_numpy(index: Any, kept: list[int]) -> None:
    part = MATCHES[index]
    assert len(part) == len(kept)
    for name in ("points0", "points1", "scores", "inliers", "indices0", "indices1"):
        whole, chosen = getattr(MATCHES, name), getattr(part, name)
        np.testing.assert_array_equal(chosen, whole[kept])
        assert chosen.dtype == whole.dtype
    assert part.geometry is MATCHES.geometry
    assert part.keypoints0 is MATCHES.keypoints0
    assert part.seconds == MATCHES.seconds


@pytest.mark.parametrize("indices", [[0, 1, 2], [0.0, 1, 2, 3], [0, 1, 2, 80], [0, 1, 2, -2]])
def test_indices_that_do_not_fit_are_an_error(indices: Any) -> None:
    with pytest.raises(OptionError, match="indices0"):
        matches_of([5, 6, 7, 8], [1, 2, 3, 4], indices0=np.array(indices))


@pytest.mark.parametrize("layer", [[0, 0, 1], [[0, 1], 0, 1, 2], [[0], [0], [0], [0]]])
def test_layers_that_do_not_fit_are_an_error(layer: Any) -> None:
    with pytest.raises(OptionError, match="layer"):
        matches_of([5, 6, 7, 8], [1, 2, 3, 4], layer=layer)


def test_indices_are_looked_up_where_none_are_given() -> None:
    rng = np.random.default_rng(0)
    rows = rng.permutation(len(GRID))[:50]
    places = KEYPOINTS.xy[rows] + rng.uniform(-0.6, 0.6, (50, 2)).astype(np.float32)
    places[0] += 2  # midway between keypoints
    found = matches_of(rows, rows, points1=places, indices0=None, indices1=None)
    np.testing.assert_array_equal(found.indices0, rows)
    np.testing.assert_array_equal(found.indices1, [-1, *rows[1:]])


def test_pairs_leave_out_what_ends_at_no_keypoint() -> None:
    found = matches_of([5, 6, 7], [1, 2, 3], indices0=[5, -1, 7], indices1=[1, 2, -1])
    assert found.pairs.dtype == np.uint32
    assert found.pairs.tolist() == [[5, 1]]
    assert MATCHES.pairs.tolist() == [[5, 1], [6, 2], [7, 3], [8, 4]]
    assert MATCHES[:0].pairs.shape == (0, 2)


def test_a_geometry_is_judged_by_the_matches_that_agree() -> None:
    rows = range(40)
    bare = matches_of(rows, rows, geometry=None, inliers=np.ones(40, bool))
    assert (bare.geometry, bare.success) == (None, True)
    for agreeing, expected in ((30, "homography"), (5, "none")):
        inliers = np.arange(40) < agreeing
        judged = bare.with_geometry(Geometry("homography", np.eye(3), inliers), 1.0)
        told = judged.geometry
        trusted = expected != "none"
        assert told.model == expected
        assert judged.success is trusted
        assert (told.scene, told.confidence) == (("planar", "fair") if trusted else ("none",) * 2)
        assert (told.matrix is not None) is trusted
        assert (told.evidence.tentative_matches, told.evidence.tentative_inliers) == (40, agreeing)
        assert (told.evidence.log10_nfa < MAX_LOG10_NFA) is trusted
        np.testing.assert_array_equal(judged.inliers, inliers & trusted)
        np.testing.assert_array_equal(judged.points0, bare.points0)
    for wrong in (0, -1, np.nan, "near"):
        with pytest.raises(OptionError, match="`inlier_threshold`"):
            bare.with_geometry(Geometry("homography", np.eye(3), inliers), wrong)  # type: ignore[arg-type]
    # What could not be estimated is no geometry either.
    nothing = bare.with_geometry(Geometry("fundamental", None, np.zeros(40, bool)))
    assert (nothing.geometry.model, nothing.success, len(nothing)) == ("none", False, 40)
    assert "40 matches; no geometry can be trusted" in repr(nothing)
    assert "none that can be trusted" in nothing._repr_html_()


def test_swapped_matches_have_the_geometry_the_other_way() -> None:
    matrix = np.array([[2.0, 0, 3], [0, 1, 1], [0, 0, 1]])
    for model, expected in (("homography", np.linalg.inv(matrix)), ("fundamental", matrix.T)):
        swapped = matches_of([5, 6], [1, 2], geometry=TwoViewGeometry(model, matrix)).swapped()
        np.testing.assert_allclose(swapped.geometry.matrix, expected)
        assert swapped.pairs.tolist() == [[1, 5], [2, 6]]
    assert matches_of([5], [1], geometry=None).swapped().geometry is None


@given(st.data())
def test_the_nearest_keypoint_is_that_of_a_search_of_all(data: st.DataObject) -> None:
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    pixels = rng.permutation(20 * 15)[: data.draw(st.integers(0, 200))]
    offsets = rng.uniform(-0.499, 0.499, (len(pixels), 2)) * data.draw(st.sampled_from([0, 1]))
    xy = np.column_stack([pixels % 20, pixels // 20]) + offsets
    keypoints = Keypoints(xy, np.ones(len(xy)), (20, 15))
    places = rng.uniform(-3, 23, (60, 2))
    found, gaps = nearest_keypoints(places, keypoints.xy, (20, 15))
    np.testing.assert_array_equal(found >= 0, np.isfinite(gaps))
    if not len(xy):
        assert (found == -1).all()
        return
    distances = np.linalg.norm(places[:, None] - keypoints.xy.astype(float), axis=2)
    near = distances.min(axis=1) <= 1
    np.testing.assert_array_equal(gaps <= 1, near)
    np.testing.assert_array_equal(distances[near, found[near]], distances[near].min(axis=1))


def test_unique_matches_are_the_best_at_both_ends() -> None:
    # 0-1 loses to 0-0, 1-1 to 1-2 (and to 0-1), 3-2 to 1-2.
    found = matches_of([0, 0, 1, 1, 3], [0, 1, 1, 2, 2], [0.9, 0.8, 0.5, 0.7, 0.6]).unique()
    assert list(zip(found.indices0, found.indices1, strict=True)) == [(0, 0), (1, 2)]
    assert len(matches_of([0, 0], [1, 2], [0.5, 0.5]).unique()) == 1
    nothing = MATCHES[:0].unique()
    assert len(nothing) == 0


def test_ends_without_a_keypoint_are_told_apart_by_their_pixel() -> None:
    between = np.array([[1.8, 2], [2.2, 2], [2.6, 2], [2, 2]], np.float32)
    lost = matches_of([0, 1, 2, 3], [0, 0, 0, 0], [0.5, 0.9, 0.7, 0.6], points1=between)
    lost = Matches(**{**vars(lost), "indices1": None})
    assert (lost.indices1 == -1).all()
    assert lost.unique().indices0.tolist() == [1, 2]


@given(
    pairs=st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=30),
    scores=st.randoms(use_true_random=False),
)
def test_unique_matches_are_one_to_one(pairs: list[tuple[int, int]], scores: Any) -> None:
    values = [scores.choice([0.1, 0.5, 0.9]) for _ in pairs]
    all_ = matches_of([a for a, _ in pairs], [b for _, b in pairs], np.array(values, np.float32))
    found = all_.unique()
    for ends in (found.indices0, found.indices1):
        assert len(set(ends.tolist())) == len(found)
    if pairs:  # the best of all stays
        assert found.scores.max() == all_.scores.max()
    assert len(found.unique()) == len(found)


def test_pickles_are_whole_and_equality_is_that_of_objects() -> None:
    copy = pickle.loads(pickle.dumps(MATCHES))
    for name in ("points0", "points1", "scores", "inliers", "indices0", "indices1"):
        np.testing.assert_array_equal(getattr(copy, name), getattr(MATCHES, name))
    assert MATCHES in [copy, MATCHES]
    assert MATCHES not in [copy]
