from __future__ import annotations

import numpy as np
import pytest

from deepdetect.batch.pair_list import motion, thin_out


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
