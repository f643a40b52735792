from __future__ import annotations

import numpy as np
import pytest

from deepdetect import OptionError
from deepdetect.datasets import load_stereo_pair


def test_the_truth_fits_the_photographs() -> None:
    """The right view, sampled at x - disparity, looks like the left view; at x + it does not."""
    pair = load_stereo_pair("motorcycle")
    assert pair.left.shape == pair.right.shape == (500, 741, 3)
    assert pair.disparity.shape == (500, 741)
    known = np.isfinite(pair.disparity)
    assert 0.9 < known.mean() < 0.95
    rows, columns = np.nonzero(known)
    shift = np.rint(pair.disparity[known]).astype(int)

    def difference(sign: int) -> float:
        there = columns - sign * shift
        inside = (there >= 0) & (there < 741)
        left = pair.left[rows[inside], columns[inside]].astype(int)
        right = pair.right[rows[inside], there[inside]].astype(int)
        return float(np.median(np.abs(left - right)))

    assert difference(1) < 0.5 * difference(-1)


def test_an_unknown_pair_names_the_nearest() -> None:
    with pytest.raises(OptionError, match="did you mean 'motorcycle'"):
        load_stereo_pair("motorcicle")
