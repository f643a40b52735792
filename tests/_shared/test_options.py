from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from deepdetect._shared.errors import OptionError
from deepdetect._shared.options import option_names, replace_options, suggest_keywords
from deepdetect.features.selection import SelectionOptions
from deepdetect.geometry import GeometryOptions
from deepdetect.matching.options import PRESETS, MatchingOptions


@dataclass(frozen=True)
class Inner:
    depth: int = 1
    name: str = "inner"


@dataclass(frozen=True)
class Outer:
    name: str = "outer"
    inner: Inner = field(default_factory=Inner)
    plain: int = 2

    def __post_init__(self) -> None:
        if self.plain < 0:
            raise OptionError(f"plain must be 0 or more, not {self.plain}")


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, Outer()),
        ({"plain": 5}, Outer(plain=5)),
        ({"depth": 7}, Outer(inner=Inner(depth=7))),
        ({"depth": 7, "plain": 5}, Outer(inner=Inner(depth=7), plain=5)),
        ({"inner": Inner(9, "x")}, Outer(inner=Inner(9, "x"))),
        # A name that both have is the outer one's.
        ({"name": "new"}, Outer(name="new")),
        # New inner options and a value of theirs: both hold.
        ({"inner": Inner(name="x"), "depth": 7}, Outer(inner=Inner(7, "x"))),
    ],
)
def test_replace_options(changes: dict[str, object], expected: Outer) -> None:
    options = Outer()
    assert replace_options(options, **changes) == expected
    assert options == Outer()


def test_names_of_nested_options() -> None:
    assert sorted(option_names(Outer())) == ["depth", "inner", "name", "plain"]


@pytest.mark.parametrize(
    ("given", "meant"), [("plane", "plain"), ("dept", "depth"), ("iner", "inner")]
)
def test_an_unknown_name(given: str, meant: str) -> None:
    with pytest.raises(OptionError, match=f"unknown option '{given}': did you mean '{meant}'"):
        replace_options(Outer(), **{given: 1})


def test_a_refused_value() -> None:
    with pytest.raises(OptionError, match="plain must be 0 or more, not -1"):
        replace_options(Outer(), plain=-1)
    with pytest.raises(OptionError, match="threshold"):
        replace_options(MatchingOptions(), threshold=2)


def test_matching_options() -> None:
    options = replace_options(
        MatchingOptions(), threshold=0.25, ratio=0.8, estimator="ransac", seed=4
    )
    assert options.selection.threshold == 0.25
    assert options.ratio == 0.8
    assert (options.geometry.estimator, options.geometry.seed) == ("ransac", 4)
    assert options.geometry.model == MatchingOptions().geometry.model


def test_a_whole_group_and_one_value_of_it() -> None:
    options = replace_options(
        MatchingOptions(),
        geometry=GeometryOptions(model="homography"),
        seed=4,
        selection=SelectionOptions(nms_radius=2),
        max_keypoints=9,
    )
    assert (options.geometry.model, options.geometry.seed) == ("homography", 4)
    assert (options.selection.nms_radius, options.selection.max_keypoints) == (2, 9)


@pytest.mark.parametrize("preset", PRESETS)
def test_no_name_is_used_twice(preset: str) -> None:
    # Keywords go by name alone, so a name must have one home. Those of guided matching are given
    # as a whole.
    options = PRESETS[preset]
    groups = [options, options.selection, options.geometry]
    groups += [options.heatmap] if options.heatmap is not None else []
    every = [name for group in groups for name in type(group).__dataclass_fields__]
    guided = set(option_names(options.guided_options))
    assert len(every) == len(set(every))
    assert set(option_names(options)) - set(every) <= guided


def test_a_decorated_function_suggests_the_right_keyword() -> None:
    @suggest_keywords
    def detect(image: str, *, max_keypoints: int | None = None) -> int | None:
        """Detect."""
        return max_keypoints

    assert detect("a.png", max_keypoints=5) == 5
    assert detect.__doc__ == "Detect."
    with pytest.raises(OptionError, match="did you mean 'max_keypoints'"):
        detect("a.png", maxkeypoints=5)
    with pytest.raises(TypeError):
        detect()
