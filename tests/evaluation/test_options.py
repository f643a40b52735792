from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from deepdetect import DeepDetect, OptionError
from deepdetect.evaluation.baselines.method import with_common_descriptor
from deepdetect.evaluation.baselines.opencv import CLASSICAL, STANDARD
from deepdetect.evaluation.options import BASELINES, THRESHOLDS, BenchmarkOptions
from deepdetect.io.image import load_image

LOW = [name for name in CLASSICAL if name.endswith("-low")]


@pytest.fixture
def options(edge_detector: DeepDetect) -> BenchmarkOptions:
    return BenchmarkOptions(edge_detector)


@pytest.mark.parametrize(
    ("change", "nearest"),
    [
        ({"classical": ("fast", "fast_low")}, "'fast-low'"),
        ({"channels": "bgrr"}, "'bgr'"),
        ({"protocols": ("paper", "standart")}, "'standard'"),
        ({"max_images": 2}, "max_images"),
        ({"geometry_weights": ("a/model.onnx", "b/model.onnx")}, "rename"),
    ],
    ids=str,
)
def test_wrong_names_bring_the_nearest(options, change, nearest: str) -> None:
    with pytest.raises(OptionError) as caught:
        dataclasses.replace(options, **change).deepdetect_480()
    assert nearest in str(caught.value)


def names(methods) -> list[str]:
    return [method.name for method in methods]


def test_the_rows_of_table_1(options: BenchmarkOptions) -> None:
    found = names(options.density_features())
    assert set(found[:14]) == set(CLASSICAL)
    thresholds = [f"deepdetect-{t}" for t in THRESHOLDS]
    assert found[14:] == [*thresholds, "random", "all-pixels"]


def test_the_rows_of_table_2(options: BenchmarkOptions) -> None:
    assert names(options.matching_features()) == [*LOW, "deepdetect-0.5", "random", "all-pixels"]


def test_the_rows_of_the_standard_protocol(options: BenchmarkOptions) -> None:
    found = names(options.standard_features())
    assert found == [
        *("sift-common", "orb-many-common", "brisk-common", "fast-common", "agast-common"),
        *("harris-maxima-common", "shi-tomasi-eigenvalue-common"),
        *("hessian-common", "hessian-scales-common", "sift-own", "orb-many-own"),
        *("sift-own-scale", "hessian-own-scale", "hessian-scales-own-scale"),
        *("deepdetect-points-common", "deepdetect-points-own-scale"),
        *("deepdetect-sparse", "deepdetect-native-common"),
        *("random-native-common", "all-pixels-common"),
    ]


def test_further_methods_are_rows_of_every_table(options: BenchmarkOptions) -> None:
    """Once each, also when a classical one is asked for again by its name."""
    own = dataclasses.replace(CLASSICAL["fast"], name="mine", title="Mine")
    others = (own, own, BASELINES["sift"], BASELINES["hessian"])
    more = dataclasses.replace(options, others=others)
    for methods in (more.density_features(), more.matching_features(), more.standard_features()):
        assert methods.count(own) == 1
        assert len(set(names(methods))) == len({m.title for m in methods}) == len(methods)


def test_the_papers_way_squashes_and_the_standard_one_does_not(options: BenchmarkOptions) -> None:
    assert "resolution=480" in options.deepdetect_480().version
    assert "native" in options.deepdetect_native().version
    bgr = dataclasses.replace(options, channels="bgr")
    assert bgr.deepdetect_480().version != options.deepdetect_480().version
    assert bgr.deepdetect_native().version != options.deepdetect_native().version


def test_methods_of_the_standard_protocol_fill_a_budget_in_an_order_of_worth(shared: Path) -> None:
    """OpenCV's ORB stops at 500; the paper's Harris marks blocks around each corner."""
    rgb = load_image(shared / "data" / "oxford" / "graf" / "img1.png")
    for method in STANDARD.values():
        found = with_common_descriptor(method).detect(rgb)
        assert len(found) >= 1000, method.name
        assert len(np.unique(found.xy, axis=0)) == len(found)
        rows = found.best(512).xy[:, 1] / rgb.shape[0]
        assert np.ptp(rows) > 0.5, method.name


def test_higher_thresholds_find_fewer_and_chance_follows_the_lowest(
    options: BenchmarkOptions, photo: np.ndarray
) -> None:
    crop = np.ascontiguousarray(photo[60:120, 60:140])
    counts = [
        len(options.deepdetect_480(threshold).detect(crop)) for threshold in (0.5, 0.7, 0.8, 0.9)
    ]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] > counts[3] > 0
    chance, every = (method.detect(crop) for method in options.chance_baselines())
    assert (len(chance), len(every)) == (counts[0], 60 * 80)
    (native,) = [f for f in options.standard_features() if f.name == "random-native-common"]
    assert len(native.detect(crop)) == len(options.deepdetect_native().detect(crop))
