from __future__ import annotations

from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from deepdetect_lab.training import (
    DescriptorTrainingOptions,
    MatcherTrainingOptions,
    MatchFilterTrainingOptions,
    PointsTrainingOptions,
    train_on_pairs,
)


@pytest.mark.parametrize("validation", ["images/val", "other"])
@pytest.mark.parametrize(
    ("options", "trainer"),
    [
        (PointsTrainingOptions(), "points.task.RankerTrainer"),
        (DescriptorTrainingOptions(), "descriptor.task.DescriptorTrainer"),
        (MatchFilterTrainingOptions(), "match_filter.MatchFilterTrainer"),
        (MatcherTrainingOptions(), "matcher.task.MatcherTrainer"),
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
