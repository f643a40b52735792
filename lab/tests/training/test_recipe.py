from __future__ import annotations

from pathlib import Path

import pytest

from deepdetect._shared.errors import OptionError
from deepdetect_lab.cli.train import chosen_recipe
from deepdetect_lab.labels import LabelOptions, find_label_settings
from deepdetect_lab.training.recipe import (
    PRESETS,
    DeviceOptions,
    PointsTrainingOptions,
    Stage,
    TrainingOptions,
)
from deepdetect_lab.training.sampler import Schedule


@pytest.mark.parametrize("text", ["240x16", "axbxc", "240x16x0", "241x1x1", "64x2x1@32"])
def test_bad_stages_are_refused(text: str) -> None:
    with pytest.raises(OptionError):
        Stage.parse(text)


@pytest.mark.parametrize(
    "bad",
    [
        {"stages": ()},
        {"stages": (Stage(480, 8, 1),), "short_sides": (240,)},
        {"stages": (Stage(64, 8, 1, (96,)),), "short_sides": (240, 64)},
        {"val_fraction": 0.0},
        {"square": "cut"},
        {"short_sides": ()},
    ],
)
def test_bad_options_are_refused(bad: dict) -> None:
    with pytest.raises(OptionError):
        TrainingOptions(**bad)


def test_the_papers_recipe() -> None:
    """33,000 + 8,000 images, a quarter darkened, 100 epochs, batch 64, Adam 0.001, 480x480."""
    paper = PRESETS["paper"]
    assert paper.stages == (Stage(480, 64, 100),)
    assert (paper.short_sides, paper.square) == ((480,), "squash")
    assert paper.dark_fraction == 0.25
    assert paper.max_images * paper.val_fraction == pytest.approx(8_000)
    schedule = Schedule(paper, 33_000)
    assert schedule.steps == 51_562
    assert schedule.learning_rate(0) == pytest.approx(1e-3)
    assert schedule.learning_rate(schedule.steps) == pytest.approx(1e-6)


def test_a_preset_keeps_its_label_settings_unless_others_are_given(tmp_path: Path) -> None:
    dense = find_label_settings("dense")
    assert chosen_recipe("dense", None, None).labels == dense
    assert chosen_recipe("dense", "sobel,fast", None).labels.settings == dense.settings
    assert chosen_recipe("dense", "fast", None).labels == LabelOptions(("fast",))
    assert chosen_recipe("dense", None, "paper").labels == LabelOptions()
    assert chosen_recipe("paper", None, "dense").labels == dense
    (tmp_path / "mine.toml").write_text("[fast]\nnormal = { threshold = 20 }\n")
    chosen = chosen_recipe("dense", None, str(tmp_path / "mine.toml")).labels
    assert list(chosen.settings) == ["fast"]


@pytest.mark.parametrize(
    ("kind", "bad"),
    [
        (DeviceOptions, {"device": "cpuu"}),
        (DeviceOptions, {"precision": "float16"}),
        (PointsTrainingOptions, {"min_density": 0.2, "max_density": 0.1}),
        (PointsTrainingOptions, {"side": 32}),
    ],
)
def test_bad_options_of_devices_and_points_are_refused(kind: type, bad: dict) -> None:
    with pytest.raises(OptionError):
        kind(**bad)
