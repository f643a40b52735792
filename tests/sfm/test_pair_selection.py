from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect import OptionError
from deepdetect.features.sift import to_root_sift
from deepdetect.sfm.pair_selection import motion, similar_pairs, thin_out, vlad_vectors
from deepdetect.sfm.stages import MultiViewOptions


def test_small_sets_are_matched_exhaustively_and_large_ones_by_likeness() -> None:
    choices = [MultiViewOptions().pair_choice(count) for count in (3, 50, 51)]
    assert choices == ["exhaustive", "exhaustive", "similar"]
    assert MultiViewOptions(pairs="sequential:2").pair_choice(3) == "sequential:2"


@pytest.mark.parametrize(
    "wrong",
    [
        {"pairs": "sequental:3"},
        {"pairs": "sequential:0"},
        {"stride_px": 1.5},
        {"mapper": "globally"},
        {"min_motion": 2},
    ],
)
def test_wrong_options_are_refused(wrong: dict) -> None:
    with pytest.raises(OptionError, match=r"sequential|must|unknown"):
        MultiViewOptions(**wrong)


def described(image: np.ndarray) -> np.ndarray:
    found = to_root_sift(cv2.SIFT_create().detectAndCompute(image, None)[1].astype(np.uint8))
    found = found.astype(np.float32)
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def test_views_of_one_thing_are_more_alike_than_others() -> None:
    data = pytest.importorskip("skimage.data", reason="needs scikit-image for its photographs")
    crops = []
    color = (data.astronaut(), data.coffee(), data.chelsea())
    for picture in (data.camera(), *(cv2.cvtColor(each, cv2.COLOR_RGB2GRAY) for each in color)):
        crops += [picture[:200, :260], picture[20:220, 40:300]]
    vectors = vlad_vectors([described(np.ascontiguousarray(crop)) for crop in crops])
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-5)
    pairs = similar_pairs([str(k) for k in range(8)], vectors, 1)
    assert pairs == [("0", "1"), ("2", "3"), ("4", "5"), ("6", "7")]


def test_a_photograph_without_keypoints_is_like_no_other() -> None:
    rng = np.random.default_rng(0)
    one = rng.random((30, 128), np.float32)
    vectors = vlad_vectors([one, one[:0], rng.random((30, 128), np.float32)])
    assert not vectors[1].any()
    assert (vectors @ vectors[1] == 0).all()


def test_of_a_large_set_those_that_see_the_same_are_matched() -> None:
    """Photographs along a wall, each of which sees 120 things, most of them new after four."""
    count = 51
    rng = np.random.default_rng(2)
    things = rng.normal(size=(30 * count + 120, 128)).astype(np.float32)
    seen = []
    for k in range(count):
        own = things[30 * k : 30 * k + 120] + 0.3 * rng.normal(size=(120, 128))
        strange = rng.normal(size=(80, 128))  # leaves, and what moves
        each = np.concatenate([own, strange]).astype(np.float32)
        seen.append(each / np.linalg.norm(each, axis=1, keepdims=True))
    names = [f"{k:03}" for k in range(count)]
    order = rng.permutation(count)
    vectors = vlad_vectors([seen[k] for k in order])
    pairs = similar_pairs([names[k] for k in order], vectors, 6)
    assert len(pairs) <= 6 * count < count * (count - 1) / 2
    found = {tuple(sorted(map(int, pair))) for pair in pairs}
    assert len(found) == len(pairs)
    for step, share in ((1, 1.0), (2, 0.95)):  # three and two quarters in common
        asked = {(k, k + step) for k in range(count - step)}
        assert len(asked & found) >= share * len(asked)


def test_frames_are_left_out_up_to_the_first_that_shows_something_new() -> None:
    near = {("a", "b"): 2.0, ("b", "c"): 2.0, ("c", "d"): 3.0}
    assert thin_out("abcd", near) == {"b": "a", "d": "c"}
    assert thin_out("dcba", near) == {"c": "d", "a": "b"}
    assert thin_out("abcd", {}) == {}
    # In a later round what others have been left out for stays.
    assert thin_out("acd", {("a", "c"): 3.5, ("c", "d"): 3.0}, {"b": "c"}) == {"d": "c"}


def test_few_matches_tell_no_motion() -> None:
    """A bonnet, or a time that is shown, stands still while all else moves."""
    rng = np.random.default_rng(0)
    first, second = rng.uniform(0, 300, (2, 100, 2))
    second[:70] = first[:70] + (3, 4)
    rows = np.column_stack([np.arange(70)] * 2)
    assert motion(first, second, rows) == pytest.approx(5)
    assert motion(first, second, rows[:49]) == np.inf
    assert motion(first, second[:90], rows[:45]) == pytest.approx(5)
