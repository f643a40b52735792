from __future__ import annotations

from typing import Any

import pytest

from deepdetect import MatchingOptions, OptionError
from deepdetect.matching import PUBLISHED_MATCHING
from deepdetect.matching.pipeline import guiding_model


def test_the_published_options_are_what_the_published_code_runs() -> None:
    """Table of notes/published-system.md in ../shared."""
    expected = {
        "descriptor": "sift",
        "keypoint_size": 3.0,
        "angle": -1.0,
        "matcher": "flann",
        "ratio": 0.99,
    }
    assert {name: getattr(PUBLISHED_MATCHING, name) for name in expected} == expected
    assert PUBLISHED_MATCHING.geometry.inlier_threshold == 1.0


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"descriptor": "siift"}, "unknown descriptor 'siift': did you mean 'sift'?"),
        ({"matcher": "flan"}, "unknown matcher 'flan': did you mean 'flann'?"),
        ({"two_view_model": "plane"}, "unknown two-view model 'plane'"),
        ({"keypoint_size": 0}, "`keypoint_size` must be above 0 and at most 100 pixels, not 0"),
        ({"keypoint_size": float("nan")}, "not nan"),
        ({"angle": 360}, "angle must lie in [0, 360) or be -1, not 360"),
        ({"angle": -2}, "not -2"),
        ({"ratio": 0}, "ratio must be above 0 and at most 1, not 0"),
        ({"ratio": 1.01}, "not 1.01"),
        ({"ratios": 1}, "unknown option 'ratios': did you mean 'ratio'"),
    ],
)
def test_wrong_options_say_what_is_wrong(values: dict[str, Any], message: str) -> None:
    with pytest.raises(OptionError) as caught:
        MatchingOptions(**values)
    assert message in str(caught.value)


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


def test_what_guides_may_not_contradict_the_model() -> None:
    with pytest.raises(OptionError, match="contradicts the model homography"):
        guiding_model("homography", MatchingOptions(two_view_model="fundamental"))
