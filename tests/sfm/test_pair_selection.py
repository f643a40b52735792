from __future__ import annotations

import numpy as np
import pytest

from deepdetect import OptionError
from deepdetect.sfm.pair_selection import motion, thin_out
from deepdetect.sfm.stages import MultiViewOptions


def test_small_sets_are_matched_exhaustively_and_large_ones_by_likeness() -> None:
    choices = [MultiViewOptions().pair_choice(count) for count in (3, 50, 51)]
    assert choices == ["exhaustive", "exhaustive", "similar"]
    assert MultiViewOptions(pairs="similar:2").pair_choice(3) == "similar:2"


@pytest.mark.parametrize(
    "wrong",
    [
        {"pairs": "sequental:3"},
        {"pairs": "sequential:0"},
        {"pairs": "similar:0"},
        {"stride_px": 1.5},
        {"mapper": "globally"},
        {"min_motion": 2},
    ],
)
def test_wrong_options_are_refused(wrong: dict) -> None:
    with pytest.raises(OptionError):
        MultiViewOptions(**wrong)


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
