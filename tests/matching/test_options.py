from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from deepdetect import (
    GeometryOptions,
    HeatmapOptions,
    MatchingOptions,
    OptionError,
    SelectionOptions,
)
from deepdetect._shared.options import option_names, replace_options
from deepdetect.matching.guided import GuidedOptions
from deepdetect.matching.guided.options import (
    InitialGeometryOptions,
    RectifiedMatchingOptions,
    VerificationOptions,
)
from deepdetect.matching.options import PRESETS, get_preset

MATRIX = np.array([[1, 0, 7], [0, 1, 0], [0, 0, 1]], float)
MASK = np.ones((20, 30), bool)


def value_at(options: Any, path: str) -> Any:
    for name in path.split("."):
        options = getattr(options, name)
    return options


def flat(options: Any, prefix: str = "") -> dict[str, Any]:
    """All single values by dotted name."""
    values: dict[str, Any] = {}
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if dataclasses.is_dataclass(value):
            values |= flat(value, f"{prefix}{field.name}.")
        else:
            values[prefix + field.name] = value
    return values


def test_the_published_preset_is_what_the_published_code_runs() -> None:
    """Table of notes/published-system.md in ../shared."""
    values = flat(get_preset("published"))
    expected = {
        "heatmap.resolution": 480,
        "heatmap.network_channels": "bgr",
        "selection.threshold": 0.5,
        "selection.density": None,
        "selection.max_keypoints": None,
        "selection.nms_radius": None,
        "descriptor": "sift",
        "keypoint_size": 3.0,
        "angle": -1.0,
        "matcher": "flann",
        "ratio": 0.99,
        "mutual": False,
        "geometry.model": "none",
        "geometry.inlier_threshold": 1.0,
    }
    assert {name: values[name] for name in expected} == expected


def test_the_default_preset_is_the_default_options() -> None:
    assert flat(get_preset("default")) == flat(MatchingOptions())
    assert get_preset("default").heatmap is None


@pytest.mark.parametrize(
    ("name", "hint"),
    [("publishd", "'published'"), ("Published", "'published'"), ("defaults", "'default'")],
)
def test_an_unknown_preset_brings_the_nearest(name: str, hint: str) -> None:
    with pytest.raises(OptionError, match=f"unknown preset '{name}': did you mean {hint}"):
        get_preset(name)


def test_a_preset_like_no_other_brings_the_whole_list() -> None:
    with pytest.raises(OptionError, match="known: default, published") as caught:
        get_preset("zzz")
    assert "did you mean" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "value", "path"),
    [
        ("descriptor", "rootsift", "descriptor"),
        ("keypoint_size", 5.0, "keypoint_size"),
        ("angle", 90.0, "angle"),
        ("matcher", "exact", "matcher"),
        ("ratio", 0.8, "ratio"),
        ("mutual", True, "mutual"),
        ("guided", True, "guided"),
        ("guide", "homography", "guide"),
        ("threshold", 0.7, "selection.threshold"),
        ("density", 0.1, "selection.density"),
        ("max_keypoints", 50, "selection.max_keypoints"),
        ("nms_radius", 2, "selection.nms_radius"),
        ("subpixel", True, "selection.subpixel"),
        ("ignore", MASK, "selection.ignore"),
        ("mode", "points", "selection.mode"),
        ("spread", "none", "selection.spread"),
        ("model", "homography", "geometry.model"),
        ("estimator", "ransac", "geometry.estimator"),
        ("inlier_threshold", 3.0, "geometry.inlier_threshold"),
        ("homography", MATRIX, "geometry.homography"),
        ("camera0", MATRIX, "geometry.camera0"),
        ("camera1", MATRIX, "geometry.camera1"),
        ("confidence", 0.5, "geometry.confidence"),
        ("iterations", 7, "geometry.iterations"),
        ("seed", 3, "geometry.seed"),
        ("resolution", 240, "heatmap.resolution"),
        ("network_channels", "rgb", "heatmap.network_channels"),
        ("tta", "flip", "heatmap.tta"),
        ("tile_megapixels", 2.0, "heatmap.tile_megapixels"),
    ],
)
def test_a_single_option_finds_its_place_and_leaves_the_others(
    name: str, value: Any, path: str
) -> None:
    preset = get_preset("published")
    before = flat(preset)
    options = replace_options(preset, **{name: value})
    after = flat(options)
    assert type(options) is MatchingOptions
    np.testing.assert_array_equal(value_at(options, path), value)
    assert after.keys() == before.keys()
    for other in before.keys() - {path}:
        assert after[other] is before[other], other
    # The preset itself stays as it was.
    assert flat(preset) == before


def test_every_option_is_in_the_table_above() -> None:
    """A new option needs a line there."""
    marks = test_a_single_option_finds_its_place_and_leaves_the_others.pytestmark
    named = {row[0] for mark in marks for row in mark.args[1]}
    groups = {"heatmap", "selection", "geometry", "guided_options"}
    guided = set(option_names(GuidedOptions()))
    assert set(option_names(get_preset("published"))) == named | groups | guided


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("selection", SelectionOptions(density=0.2)),
        ("geometry", GeometryOptions(model="none")),
        ("heatmap", HeatmapOptions(64)),
        ("heatmap", None),
    ],
)
def test_a_whole_group_can_be_given(name: str, value: Any) -> None:
    assert getattr(replace_options(get_preset("published"), **{name: value}), name) is value


def test_the_two_cameras_of_an_essential_matrix_come_with_it() -> None:
    """Options that are only valid together can be given together."""
    options = replace_options(MatchingOptions(), model="essential", camera0=MATRIX, camera1=MATRIX)
    assert options.geometry.model == "essential"
    with pytest.raises(OptionError, match="needs both cameras"):
        replace_options(MatchingOptions(), model="essential", camera0=MATRIX)


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("ratios", "ratio"),
        ("matchers", "matcher"),
        ("tresholds", "threshold"),
        ("max_keypoint", "max_keypoints"),
        ("homografy", "homography"),
        ("inlier_treshold", "inlier_threshold"),
    ],
)
def test_an_unknown_option_brings_the_nearest(name: str, meant: str) -> None:
    with pytest.raises(OptionError, match=f"unknown option '{name}': did you mean '{meant}'"):
        replace_options(MatchingOptions(), **{name: 1})


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"descriptor": "siift"}, "unknown descriptor 'siift': did you mean 'sift'?"),
        ({"matcher": "flan"}, "unknown matcher 'flan': did you mean 'flann'?"),
        ({"keypoint_size": 0}, "`keypoint_size` must be above 0 and at most 100 pixels, not 0"),
        ({"keypoint_size": 101}, "not 101"),
        ({"keypoint_size": float("nan")}, "not nan"),
        ({"angle": 360}, "angle must lie in [0, 360) or be -1, not 360"),
        ({"angle": -2}, "not -2"),
        ({"angle": float("nan")}, "not nan"),
        ({"ratio": 0}, "ratio must be above 0 and at most 1, not 0"),
        ({"ratio": 1.01}, "not 1.01"),
        ({"ratio": float("nan")}, "not nan"),
    ],
)
def test_wrong_options_say_what_is_wrong(values: dict[str, Any], message: str) -> None:
    for make in (
        MatchingOptions,
        lambda **values: replace_options(get_preset("published"), **values),
    ):
        with pytest.raises(OptionError) as caught:
            make(**values)
        assert message in str(caught.value)


@pytest.mark.parametrize(
    "values",
    [
        {"keypoint_size": 100},
        {"keypoint_size": 0.1},
        {"angle": -1},
        {"angle": 0},
        {"angle": 359.9},
        {"ratio": 1},
        {"ratio": 0.01},
    ],
)
def test_the_ends_of_the_ranges_are_taken(values: dict[str, Any]) -> None:
    assert flat(MatchingOptions(**values)).items() >= values.items()


@pytest.mark.parametrize("name", PRESETS)
def test_presets_cannot_be_changed_in_place(name: str) -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        get_preset(name).ratio = 0.5


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: MatchingOptions(guide="plane"), "unknown guide 'plane'"),
        (
            lambda: MatchingOptions(guide="fundamental", geometry=GeometryOptions("homography")),
            "the guide fundamental contradicts the model homography",
        ),
        (
            lambda: InitialGeometryOptions(max_ratios=(0.8, 1.2)),
            "`max_ratios` must lie in [0, 1], not (0.8, 1.2)",
        ),
        (lambda: VerificationOptions(keypoint_sizes_px=()), "`keypoint_sizes_px` must be above 0"),
        (lambda: VerificationOptions(false_positive_rate=-0.1), "`false_positive_rate` must lie"),
        (
            lambda: RectifiedMatchingOptions(max_round_trip_px=0),
            "`max_round_trip_px` must be above",
        ),
        (
            lambda: RectifiedMatchingOptions(max_row_error_px=float("nan")),
            "`max_row_error_px` must be above 0",
        ),
        (lambda: GuidedOptions(min_matched_fraction=2), "`min_matched_fraction` must lie"),
    ],
)
def test_wrong_options_of_guided_matching(make: Any, message: str) -> None:
    with pytest.raises(OptionError) as caught:
        make()
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("model", "guide", "expected"),
    [
        ("auto", "auto", "auto"),
        ("none", "auto", "auto"),
        ("homography", "auto", "homography"),
        ("fundamental", "auto", "fundamental"),
        ("none", "fundamental", "fundamental"),
        ("auto", "homography", "homography"),
    ],
)
def test_the_model_chooses_the_guide_unless_it_is_named(
    model: str, guide: str, expected: str
) -> None:
    options = MatchingOptions(guide=guide, geometry=GeometryOptions(model))
    assert options.guiding_model == expected
