from __future__ import annotations

import numpy as np
import pytest

from deepdetect import OptionError
from deepdetect.features.descriptors import DESCRIPTORS, get_descriptor
from deepdetect.features.sift import (
    opencv_sift_descriptors,
    root_sift_descriptors,
    sift_descriptors,
)


def test_the_documented_names_exist() -> None:
    assert get_descriptor("sift") is sift_descriptors
    assert get_descriptor("rootsift") is root_sift_descriptors
    assert get_descriptor("sift-opencv") is opencv_sift_descriptors


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("siift", "did you mean 'sift'?"),
        ("SIFT", "did you mean 'sift'?"),
        ("root_sift", "did you mean 'rootsift'?"),
        ("RootSIFT", "did you mean 'rootsift'?"),
    ],
)
def test_an_unknown_name_brings_the_nearest(name: str, hint: str) -> None:
    with pytest.raises(OptionError) as caught:
        get_descriptor(name)
    assert repr(name) in str(caught.value)
    assert hint in str(caught.value)


@pytest.mark.parametrize("name", ["", "qqq", None, 3])
def test_a_name_like_no_other_brings_the_whole_list(name: object) -> None:
    with pytest.raises(OptionError, match="known: sift, rootsift") as caught:
        get_descriptor(name)
    assert "did you mean" not in str(caught.value)


@pytest.mark.parametrize("name", DESCRIPTORS)
@pytest.mark.parametrize("count", [0, 1, 5])
def test_every_descriptor_keeps_the_contract(name: str, count: int) -> None:
    rng = np.random.default_rng(0)
    gray = rng.integers(0, 256, (40, 50)).astype(np.uint8)
    xy = rng.integers(0, 40, (count, 2)).astype(np.float32)
    before = gray.copy(), xy.copy()
    descriptors = DESCRIPTORS[name](gray, xy, 3.0, 0.0)
    assert descriptors.dtype == np.uint8
    assert descriptors.ndim == 2
    assert len(descriptors) == count
    np.testing.assert_array_equal(gray, before[0])
    np.testing.assert_array_equal(xy, before[1])
