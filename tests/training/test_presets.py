from __future__ import annotations

from pathlib import Path

import pytest

from deepdetect import OptionError
from deepdetect.cli.recipe import chosen_recipe
from deepdetect.labels import find_label_settings
from deepdetect.training.presets import training_preset
from deepdetect.training.recipe import Stage, TrainingOptions
from deepdetect.training.schedule import Schedule


def test_the_papers_recipe() -> None:
    """33,000 + 8,000 images, a quarter darkened, 100 epochs, batch 64, Adam 0.001, 480x480."""
    paper = training_preset("paper")
    assert paper.stages == (Stage(480, 64, 100),)
    assert (paper.short_sides, paper.square) == ((480,), True)
    assert paper.dark_fraction == 0.25
    assert paper.max_photos * paper.val_fraction == pytest.approx(8_000)
    schedule = Schedule(paper, 33_000)
    assert schedule.steps == 51_562
    assert schedule.learning_rate(0) == pytest.approx(1e-3)
    assert schedule.learning_rate(schedule.steps) == pytest.approx(1e-6)


def test_the_recipe_for_geometry() -> None:
    """Normal light only, and the labels of the name."""
    geometry = training_preset("dense")
    assert geometry.dark_fraction == 0
    assert geometry.label_changes == find_label_settings("dense").changes
    assert Schedule(geometry, 2_705).steps > 1_000


def test_a_preset_keeps_its_label_settings_unless_others_are_given(tmp_path: Path) -> None:
    changes = training_preset("dense").label_changes
    assert chosen_recipe("dense", None, None, {}).label_changes == changes
    assert chosen_recipe("dense", "sobel,fast", None, {}).label_changes == changes
    assert chosen_recipe("dense", "fast", None, {}).label_changes == ()
    assert chosen_recipe("dense", None, "paper", {}).label_changes == ()
    assert chosen_recipe("paper", None, "dense", {}).label_changes == changes
    (tmp_path / "mine.toml").write_text("[fast]\nnormal = { threshold = 20 }\n")
    (change,) = chosen_recipe("dense", None, str(tmp_path / "mine.toml"), {}).label_changes
    assert change.detector == "fast"


def test_the_default_is_that_of_the_options() -> None:
    assert training_preset("default") == TrainingOptions()


def test_an_unknown_preset_is_refused() -> None:
    with pytest.raises(OptionError, match="did you mean 'paper'"):
        training_preset("papers")
