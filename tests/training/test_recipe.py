from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect._shared.errors import OptionError
from deepdetect._shared.options import replace_options
from deepdetect.training.recipe import Stage, TrainingOptions
from deepdetect.training.schedule import Schedule


@pytest.mark.parametrize(
    "text",
    ["240x16", "axbxc", "240x16x0", "0x1x1", "241x1x1", "240x0x1", "64x2x1@32", "64x2x1@", "64@64"],
)
def test_bad_stages_are_refused(text: str) -> None:
    with pytest.raises(OptionError):
        Stage.parse(text)


@pytest.mark.parametrize(
    "bad",
    [
        {"stages": ()},
        {"stages": (Stage(480, 8, 1),), "short_sides": (240,)},
        {"stages": (Stage(64, 8, 1, (96,)),), "short_sides": (240, 64)},
        {"dark_fraction": 1.5},
        {"dark_variants": 0},
        {"augmentations": -1},
        {"pos_weight": 0.0},
        {"pos_weight": float("nan")},
        {"low_light_pos_weight": 0.0},
        {"pos_weight_uncertain": True},
        {"color_jitter": 1.5},
        {"val_count": 0},
        {"learning_rate": -1.0},
        {"warm_up": -1},
        {"detectors": ("siift",)},
        {"short_sides": ()},
    ],
)
def test_bad_options_are_refused(bad: dict) -> None:
    with pytest.raises(OptionError):
        TrainingOptions(**bad)


def test_an_unknown_option_names_the_nearest() -> None:
    with pytest.raises(OptionError, match="did you mean 'learning_rate'"):
        replace_options(TrainingOptions(), learning_rat=1)


def test_options_are_kept_as_json() -> None:
    assert json.loads(TrainingOptions(seed=7).to_json())["seed"] == 7


def test_learning_rate_is_a_cosine_from_first_to_final() -> None:
    schedule = Schedule(TrainingOptions(stages=(Stage(64, 2, 10),), short_sides=(64,)), 20)
    assert schedule.steps == 100
    assert schedule.learning_rate(0) == pytest.approx(1e-3)
    assert schedule.learning_rate(50) == pytest.approx((1e-3 + 1e-6) / 2)
    assert schedule.learning_rate(100) == pytest.approx(1e-6)


def test_the_warm_up_rises_evenly_into_the_cosine() -> None:
    stages = (Stage(64, 2, 10),)
    plain = Schedule(TrainingOptions(stages=stages, short_sides=(64,)), 20)
    warm = Schedule(TrainingOptions(stages=stages, short_sides=(64,), warm_up=9), 20)
    shares = [warm.learning_rate(step) / plain.learning_rate(step) for step in range(12)]
    assert shares == pytest.approx([k / 10 for k in range(1, 11)] + [1, 1])


@given(
    photos=st.integers(1, 50),
    stages=st.lists(st.tuples(st.integers(1, 8), st.integers(1, 4)), min_size=1, max_size=3),
)
def test_positions_run_through_the_stages(photos: int, stages: list[tuple[int, int]]) -> None:
    made = tuple(Stage(16, batch, epochs) for batch, epochs in stages)
    schedule = Schedule(TrainingOptions(stages=made, short_sides=(16,)), photos)
    step = 0
    for k, stage in enumerate(made):
        for within in range(schedule.steps_of_stage[k]):
            position = schedule.position(step)
            assert position.stage == stage
            assert position.sample == within * stage.batch
            step += 1
    assert step == schedule.steps
    with pytest.raises(IndexError):
        schedule.position(step)


@given(steps=st.integers(1, 40), count=st.integers(1, 60))
def test_the_last_step_is_a_milestone(steps: int, count: int) -> None:
    options = TrainingOptions(stages=(Stage(16, 1, 1),), short_sides=(16,))
    milestones = Schedule(options, steps).milestones(count)
    assert max(milestones) == steps
    assert min(milestones) > 0


@given(
    photos=st.integers(1, 50),
    stages=st.lists(st.tuples(st.integers(1, 8), st.integers(1, 4)), min_size=1, max_size=3),
)
def test_interleaved_stages_advance_together(photos: int, stages: list[tuple[int, int]]) -> None:
    made = tuple(Stage(16, batch, epochs) for batch, epochs in stages)
    options = TrainingOptions(stages=made, short_sides=(16,))
    mixed = Schedule(replace_options(options, interleave=True), photos)
    plain = Schedule(options, photos)
    positions = [mixed.position(step) for step in range(mixed.steps)]
    expected = [plain.position(step) for step in range(plain.steps)]
    key = lambda position: (position.number, position.sample)  # noqa: E731
    assert sorted(positions, key=key) == sorted(expected, key=key)
    done = [0] * len(made)
    for step, position in enumerate(positions, start=1):
        assert position.sample == done[position.number] * position.stage.batch
        done[position.number] += 1
        for number, total in enumerate(mixed.steps_of_stage):
            assert abs(done[number] - total * step / mixed.steps) < len(made) + 1
