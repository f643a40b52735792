from __future__ import annotations

import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect_lab.training.recipe import Stage
from deepdetect_lab.training.sampler import Schedule, epoch_order

from .conftest import plain_options

OPTIONS = plain_options(stages=(Stage(64, 4, 2), Stage(32, 2, 1)), short_sides=(64,), seed=5)


def test_the_warm_up_rises_evenly_into_the_cosine() -> None:
    stages = (Stage(64, 2, 10),)
    plain = Schedule(plain_options(stages=stages, short_sides=(64,)), 20)
    warm = Schedule(plain_options(stages=stages, short_sides=(64,), warm_up=0.09), 20)
    shares = [warm.learning_rate(step) / plain.learning_rate(step) for step in range(12)]
    assert shares == pytest.approx([k / 10 for k in range(1, 11)] + [1, 1])


def test_crops_are_counted() -> None:
    schedule = Schedule(OPTIONS, 10)
    assert [schedule.crops_until(step) for step in (0, 1, 5, 6, 10)] == [0, 4, 20, 22, 30]


@given(
    photos=st.integers(1, 50),
    stages=st.lists(st.tuples(st.integers(1, 8), st.integers(1, 4)), min_size=1, max_size=3),
)
def test_interleaved_stages_advance_together(photos: int, stages: list[tuple[int, int]]) -> None:
    made = tuple(Stage(16, batch, epochs) for batch, epochs in stages)
    options = plain_options(stages=made, short_sides=(16,))
    mixed = Schedule(dataclasses.replace(options, interleave=True), photos)
    plain = Schedule(options, photos)
    batches = list(mixed.batches())
    assert sorted(batches, key=str) == sorted(plain.batches(), key=str)
    done = [0] * len(made)
    starts = [sum(stage.epochs for stage in made[:k]) for k in range(len(made))]
    for step, (first, *_) in enumerate(batches, start=1):
        number = max(k for k, start in enumerate(starts) if start <= first.epoch)
        sample = (first.epoch - starts[number]) * photos + first.position
        assert (first.stage, sample) == (made[number], done[number] * made[number].batch)
        done[number] += 1
        for number, total in enumerate(mixed.steps_of_stage):
            assert abs(done[number] - total * step / mixed.steps) < len(made) + 1


def test_each_image_is_seen_once_an_epoch() -> None:
    orders = [epoch_order(0, epoch, 12).tolist() for epoch in range(3)]
    for order in orders:
        assert sorted(order) == list(range(12))
    assert orders[0] != orders[1]
    assert epoch_order(1, 0, 12).tolist() != orders[0]


def test_batches_go_through_the_epochs_of_each_stage() -> None:
    schedule = Schedule(OPTIONS, 10)
    assert len(list(schedule.batches())) == schedule.steps == 5 + 5
    crops = [index for batch in schedule.batches() for index in batch]
    assert [index.epoch for index in crops] == [0] * 10 + [1] * 10 + [2] * 10
    assert [index.stage.crop for index in crops] == [64] * 20 + [32] * 10
    for epoch in range(3):
        images = [index.image for index in crops if index.epoch == epoch]
        assert images == epoch_order(5, epoch, 10).tolist()
    assert [index.position for index in crops] == 3 * list(range(10))


def test_batches_start_at_any_step() -> None:
    schedule = Schedule(OPTIONS, 10)
    assert list(schedule.batches(3)) == list(schedule.batches())[3:]
