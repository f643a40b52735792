from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from deepdetect import DeepDetect, OptionError
from deepdetect.evaluation.baselines import CLASSICAL, STANDARD
from deepdetect.evaluation.options import COMMON_DESCRIPTOR, DEFAULT, LOW, common
from deepdetect.evaluation.protocols import BenchmarkOptions
from deepdetect.features.sift import root_sift_descriptors
from deepdetect.io.image import load_image, luma


@pytest.fixture
def options(edge_detector: DeepDetect) -> BenchmarkOptions:
    return BenchmarkOptions(edge_detector)


def test_all_classical_methods_are_default_or_low() -> None:
    assert {*DEFAULT, *LOW} == set(CLASSICAL)
    assert len(DEFAULT) == len(LOW) == 7


@pytest.mark.parametrize(
    ("change", "nearest"),
    [
        ({"protocols": ("papr",)}, "'paper'"),
        ({"protocols": ("paper", "standrad")}, "'standard'"),
        ({"classical": ("siift",)}, "'sift'"),
        ({"classical": ("fast", "fast_low")}, "'fast-low'"),
        ({"protocols": ()}, "paper or standard"),
        ({"channels": "bgrr"}, "'bgr'"),
    ],
    ids=str,
)
def test_wrong_names_bring_the_nearest(options, change, nearest: str, one_line) -> None:
    with pytest.raises(OptionError) as caught:
        dataclasses.replace(options, **change).own()
    assert nearest in one_line(caught.value)


def names(methods) -> list[str]:
    return [method.name for method in methods]


def test_the_rows_of_table_1(options: BenchmarkOptions) -> None:
    found = names(options.density_methods())
    assert set(found[:14]) == set(CLASSICAL)
    thresholds = [f"deepdetect-{t}" for t in (0.5, 0.7, 0.8, 0.9)]
    assert found[14:] == [*thresholds, "random", "every-pixel"]


def test_the_rows_of_table_2(options: BenchmarkOptions) -> None:
    assert names(options.matching_methods()) == [*LOW, "deepdetect-0.5", "random", "every-pixel"]


def test_the_rows_of_the_standard_protocol(options: BenchmarkOptions) -> None:
    found = names(options.standard_methods())
    assert found == [
        *("sift-common", "orb-many-common", "brisk-common", "fast-common", "agast-common"),
        *("harris-maxima-common", "shi-tomasi-eigenvalue-common", "sift-own", "orb-many-own"),
        *("deepdetect-sparse", "deepdetect-native-common"),
        *("random-native-common", "every-pixel-common"),
    ]


@pytest.mark.parametrize("rows", ["density_methods", "matching_methods", "standard_methods"])
@pytest.mark.parametrize("extra", ["fast-low", "sift", "harris"])
def test_no_method_is_a_row_twice(options: BenchmarkOptions, rows: str, extra: str) -> None:
    """Also when a classical one is asked for again by its name."""
    more = dataclasses.replace(options, others=(CLASSICAL[extra], CLASSICAL[extra]))
    methods = getattr(more, rows)()
    assert len(set(names(methods))) == len(methods)
    titles = [method.title for method in methods]
    assert len(set(titles)) == len(titles)


def test_further_methods_are_rows_of_every_table(options: BenchmarkOptions) -> None:
    own = dataclasses.replace(CLASSICAL["fast"], name="mine", title="Mine")
    more = dataclasses.replace(options, classical=(), others=(own,))
    for methods in (more.density_methods(), more.matching_methods(), more.standard_methods()):
        assert own in methods
        assert methods.index(own) == 0


def test_none_of_the_classical_methods_may_be_wanted(options: BenchmarkOptions) -> None:
    none = dataclasses.replace(options, classical=())
    assert names(none.matching_methods()) == ["deepdetect-0.5", "random", "every-pixel"]
    assert names(none.density_methods())[0] == "deepdetect-0.5"


def test_the_papers_way_squashes_and_the_standard_one_does_not(options: BenchmarkOptions) -> None:
    assert "resolution=480" in options.own().version
    assert "native" in options.native().version
    bgr = dataclasses.replace(options, channels="bgr")
    assert bgr.own().version != options.own().version
    assert bgr.native().version != options.native().version


def test_methods_of_the_standard_protocol_fill_a_budget_in_an_order_of_worth(
    shared: Path,
) -> None:
    """OpenCV's ORB stops at 500; the paper's Harris marks blocks around each corner."""
    rgb = load_image(shared / "data" / "oxford" / "graf" / "img1.png")
    for method in STANDARD.values():
        found = common(method).detect(rgb)
        assert len(found) >= 1000, method.name
        assert len(np.unique(found.xy, axis=0)) == len(found)
        rows = found.best(512).xy[:, 1] / rgb.shape[0]
        assert np.ptp(rows) > 0.5, method.name


def test_the_common_descriptor_takes_the_place_of_any(
    photo: np.ndarray,
) -> None:
    crop = np.ascontiguousarray(photo[60:160, 60:160])
    for name in ("orb", "sift", "fast"):
        method = common(CLASSICAL[name])
        assert not method.binary
        assert method.version != CLASSICAL[name].version
        found = method.detect(crop)[:40]
        expected = root_sift_descriptors(luma(crop), found.xy, 4.0, 0.0)
        np.testing.assert_array_equal(method.describe(crop, found), expected)
    assert (COMMON_DESCRIPTOR.name, COMMON_DESCRIPTOR.size, COMMON_DESCRIPTOR.angle) == (
        *("rootsift", 4.0),
        0.0,
    )


def test_higher_thresholds_find_fewer_and_controls_follow_the_lowest(
    options: BenchmarkOptions, photo: np.ndarray
) -> None:
    crop = np.ascontiguousarray(photo[60:120, 60:140])
    counts = [len(options.own(threshold).detect(crop)) for threshold in (0.5, 0.7, 0.8, 0.9)]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] > counts[3] > 0
    chance, every = (method.detect(crop) for method in options.controls())
    assert (len(chance), len(every)) == (counts[0], 60 * 80)
    assert len(options.native_controls()[0].detect(crop)) == len(options.native().detect(crop))
