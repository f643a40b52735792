from __future__ import annotations

from typing import Any

import pytest

from deepdetect import MatchingOptions, OptionError
from deepdetect.matching import PUBLISHED_MATCHING
from deepdetect.matching.pipeline import guiding_model


def test_the_published_options_are_what_the_published_code_runs() -> None:
    """Table of notes/published-system.md in ../shared."""
    published = PUBLISHED_MATCHING
    assert (published.descriptor, published.keypoint_size, published.angle) == ("sift", 3.0, -1.0)
    assert (published.matcher, published.ratio) == ("flann", 0.99)
    assert published.geometry.inlier_threshold == 1.0


@pytest.mark.parametrize(
    "values",
    [
        {"descriptor": "siift"},
        {"matcher": "flan"},
        {"matcher": "hamming"},
        {"two_view_model": "plane"},
        {"keypoint_size": 0},
        {"keypoint_size": float("nan")},
        {"angle": 360},
        {"angle": -2},
        {"ratio": 0},
        {"ratio": 1.01},
    ],
    ids=str,
)
def test_wrong_options_are_refused(values: dict[str, Any]) -> None:
    with pytest.raises(OptionError):
        MatchingOptions(**values)


@pytest.mark.parametrize(
    ("model", "given", "expected"),
    [
        ("auto", "auto", "auto"),
        ("none", "auto", "auto"),
        ("homography", "auto", "homography"),
        ("essential", "auto", "fundamental"),
        ("none", "fundamental", "fundamental"),
        ("auto", "homography", "homography"),
    ],
)
def test_the_model_chooses_what_guides_unless_it_is_named(
    model: str, given: str, expected: str
) -> None:
    assert guiding_model(model, MatchingOptions(two_view_model=given)) == expected
