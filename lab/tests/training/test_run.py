from __future__ import annotations

from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from deepdetect_lab.labels import LabelOptions
from deepdetect_lab.training import (
    DescriptorTrainingOptions,
    DeviceOptions,
    MatchFilterTrainingOptions,
    PointsTrainingOptions,
    Stage,
    TrainingOptions,
    profile,
    train_on_pairs,
)


@pytest.mark.slow
def test_a_profile_times_each_stage_and_writes_no_weights(
    photographs: Path, tmp_path: Path
) -> None:
    options = TrainingOptions(
        stages=(Stage(64, 4, 4), Stage(96, 2, 1)),
        short_sides=(96,),
        labels=LabelOptions(("fast",)),
        interleave=True,
    )
    device = DeviceOptions("cpu", "float32", compile=False, threads=1)
    lines: list[str] = []
    first, second = profile(
        photographs, tmp_path, options, device=device, workers=1, log=lines.append
    )
    assert lines == ["timing cpu, float32, eager"]
    assert (first["stage"]["crop"], second["stage"]["crop"]) == (64, 96)
    assert first["steps"] == 11 * 4 // 4 - 5
    assert second["steps"] == 1, "as many as the stage has, the warm-up left out"
    for row in (first, second):
        rate = row["images_per_second"]
        assert rate > 0
        assert row["full_images_per_second"] == rate * row["stage"]["crop"] ** 2 / 480**2
        assert 0 <= row["waiting_fraction"] < 1
        assert 50e6 < row["memory_bytes"] < 20e9
        assert row["device_memory_bytes"] == 0
    assert {path.name for path in tmp_path.iterdir()} == {"labels"}


@pytest.mark.parametrize("validation", ["images/val", "other"])
@pytest.mark.parametrize(
    ("options", "trainer"),
    [
        (PointsTrainingOptions(), "points.task.RankerTrainer"),
        (DescriptorTrainingOptions(), "descriptor.task.DescriptorTrainer"),
        (MatchFilterTrainingOptions(), "match_filter.MatchFilterTrainer"),
    ],
)
def test_pictures_of_validation_and_of_the_run_are_not_trained_on(
    options: Any, trainer: str, validation: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    images, output = tmp_path / "images", tmp_path / "images/run"
    for path in (
        images / "0.png",
        images / "a/1.png",
        output / "2.png",
        tmp_path / validation / "3.png",
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    made = Mock()
    monkeypatch.setattr(f"deepdetect_lab.training.{trainer}", made)
    train_on_pairs(images, tmp_path / validation, output, options)
    listed, held_out = made.call_args.args[:2]
    assert listed == [images / "0.png", images / "a/1.png"]
    assert held_out == [tmp_path / validation / "3.png"]
