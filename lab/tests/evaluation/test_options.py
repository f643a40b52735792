from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from deepdetect import DeepDetect, OptionError
from deepdetect.detector.heatmap import HeatmapOptions
from deepdetect.io.image import load_image
from deepdetect_lab.evaluation.baselines.method import with_common_descriptor
from deepdetect_lab.evaluation.baselines.opencv import CLASSICAL, STANDARD
from deepdetect_lab.evaluation.masks import LabelDetector
from deepdetect_lab.evaluation.options import (
    BASELINES,
    PAPER_RESOLUTION_PX,
    BenchmarkOptions,
)


@pytest.fixture
def options(edge_detector: DeepDetect) -> BenchmarkOptions:
    return BenchmarkOptions(edge_detector)


@pytest.mark.parametrize(
    "change",
    [
        {"classical": ("fast", "fast_low")},
        {"protocols": ("paper", "standart")},
        {"max_images": 2},
        {"geometry_weights": ("a/model.onnx", "b/model.onnx")},
    ],
    ids=str,
)
def test_wrong_options_are_refused(options, change) -> None:
    with pytest.raises(OptionError):
        dataclasses.replace(options, **change).deepdetect_480()


def names(methods) -> list[str]:
    return [method.name for method in methods]


def test_further_methods_are_rows_of_every_table(options: BenchmarkOptions) -> None:
    """Once each, also when a classical one is asked for again by its name."""
    own = dataclasses.replace(CLASSICAL["fast"], name="mine", title="Mine")
    others = (own, own, BASELINES["sift"], BASELINES["hessian"])
    more = dataclasses.replace(options, others=others)
    for methods in (more.density_features(), more.matching_features(), more.standard_features()):
        assert methods.count(own) == 1
        assert len(set(names(methods))) == len({m.title for m in methods}) == len(methods)


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


def test_at_equal_density_there_are_as_many_pixels_as_the_label_marks(
    options: BenchmarkOptions, photo: np.ndarray
) -> None:
    equal = dataclasses.replace(options, equal_density=True)
    feature = equal.deepdetect_480()
    label = LabelDetector(heatmap_options=HeatmapOptions(PAPER_RESOLUTION_PX)).heatmap(photo)
    assert len(feature.detect(photo)) == np.count_nonzero(label > 0.5)
    assert feature.key != options.deepdetect_480().key
    own = [name for name in names(equal.density_features()) if name.startswith("deepdetect")]
    assert own == [feature.name]
