from __future__ import annotations

import pytest

from deepdetect import OptionError
from deepdetect.training.presets import training_preset
from deepdetect.training.recipe import Stage, TrainingOptions
from deepdetect.training.schedule import Schedule


def test_the_papers_recipe() -> None:
    """33,000 + 8,000 images, a quarter darkened, 100 epochs, batch 64, Adam 0.001, 480x480."""
    paper = training_preset("paper")
    assert paper.stages == (Stage(480, 64, 100),)
    assert (paper.short_sides, paper.square) == ((480,), True)
    assert paper.dark_fraction == 0.25
    assert paper.max_photos * paper.held_out == pytest.approx(8_000)
    schedule = Schedule(paper, 33_000)
    assert schedule.steps == 51_562
    assert schedule.learning_rate(0) == pytest.approx(1e-3)
    assert schedule.learning_rate(schedule.steps) == pytest.approx(1e-6)


def test_the_default_is_that_of_the_options() -> None:
    assert training_preset("default") == TrainingOptions()


def test_an_unknown_preset_is_refused() -> None:
    with pytest.raises(OptionError, match="did you mean 'paper'"):
        training_preset("papers")
