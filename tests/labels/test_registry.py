from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect._shared.errors import OptionError
from deepdetect.labels.registry import DETECTOR_NAMES, DETECTORS, LabelDetector, select_detectors

NAMES = ("sift", "orb", "brisk", "fast", "agast", "harris", "shi-tomasi", "canny", "sobel")

# The settings that reproduce the published labels (shared/notes/labels.md).
PUBLISHED: dict[str, dict[str, Any]] = {
    "sift": {
        "contrast_threshold": 0.04,
        "edge_threshold": 1000,
        "sigma": 1.6,
        "octave_layers": 3,
    },
    "orb": {
        "features": 1_000_000,
        "scale_factor": 1.2,
        "levels": 7,
        "edge_threshold": 13,
        "fast_threshold": 13,
    },
    "brisk": {"threshold": 11, "octaves": 3},
    "fast": {"threshold": 13, "suppression": False},
    "agast": {"threshold": 13, "suppression": False},
    "harris": {
        "block_size": 3,
        "aperture": 5,
        "k": 0.001,
        "relative_threshold": 0.001,
        "dilate": True,
    },
    "shi-tomasi": {
        "corners": 0,
        "quality_level": 0.01,
        "minimum_distance": 1,
        "block_size": 2,
    },
    "canny": {"low_threshold": 150, "high_threshold": 250},
    "sobel": {"kernel_size": 11, "relative_threshold": 0.1},
}
LOW_CHANGES = {
    "fast": {"threshold": 1},
    "agast": {"threshold": 1},
    "sobel": {"relative_threshold": 0.5},
}


def test_the_nine_in_order() -> None:
    assert DETECTOR_NAMES == NAMES
    assert {d.name for d in DETECTORS if d.kind == "edge"} == {"canny", "sobel"}
    assert {d.kind for d in DETECTORS} == {"edge", "keypoint"}


@pytest.mark.parametrize("detector", DETECTORS, ids=NAMES)
def test_published_settings(detector: LabelDetector) -> None:
    assert dataclasses.asdict(detector.normal) == PUBLISHED[detector.name]
    low = PUBLISHED[detector.name] | LOW_CHANGES.get(detector.name, {})
    assert dataclasses.asdict(detector.low_visibility) == low


@pytest.mark.parametrize("detector", DETECTORS, ids=NAMES)
def test_masks_are_boolean_and_of_the_images_size(
    detector: LabelDetector, gray: np.ndarray
) -> None:
    for settings in (detector.normal, detector.low_visibility):
        before = gray.copy()
        mask = detector.mask(gray, settings)
        assert mask.dtype == bool
        assert mask.shape == gray.shape
        assert mask.any()
        np.testing.assert_array_equal(gray, before)
        np.testing.assert_array_equal(detector.mask(gray, settings), mask)


@pytest.mark.parametrize("detector", DETECTORS, ids=NAMES)
def test_settings_are_frozen(detector: LabelDetector) -> None:
    field = dataclasses.fields(detector.normal)[0].name
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(detector.normal, field, 1)


@given(st.lists(st.sampled_from(NAMES), min_size=1, max_size=12))
def test_a_selection_has_the_order_of_the_registry(names: list[str]) -> None:
    chosen = [detector.name for detector in select_detectors(names)]
    assert chosen == [name for name in NAMES if name in names]


@pytest.mark.parametrize(
    ("given", "nearest"),
    [("siift", "sift"), ("shi_tomasi", "shi-tomasi"), ("SOBEL", "sobel"), ("haris", "harris")],
)
def test_an_unknown_name_is_told_the_nearest(given: str, nearest: str) -> None:
    with pytest.raises(OptionError, match=f"'{given}': did you mean '{nearest}'") as caught:
        select_detectors(["fast", given])
    assert all(name in str(caught.value) for name in NAMES)


def test_no_name() -> None:
    with pytest.raises(OptionError, match="no label detector was chosen"):
        select_detectors([])
