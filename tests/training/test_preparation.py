from __future__ import annotations

from pathlib import Path

from deepdetect.training.preparation import Sources, prepare
from deepdetect.training.recipe import Stage, TrainingOptions


def test_validation_takes_the_first_size_only(photographs: Path, tmp_path: Path) -> None:
    options = TrainingOptions(
        stages=(Stage(64, 2, 1),), short_sides=(64, 96), detectors=("fast",), val_fraction=0.3
    )
    made = prepare(Sources(photographs, tmp_path), options, workers=1)
    names = [path.name for path in (tmp_path / "labels").rglob("*.png")]
    held = {example.photo.digest for example in made.held}
    assert held
    assert len(made.training) + len(held) == 12
    for name in names:
        if name.split("_")[1] in held:
            assert name.split("_")[2] == "64"
    assert len(names) == 4 * len(made.training) + 2 * len(held)
    for example in made.held:
        image, mask = example.load(example.photo.normal[0])
        assert min(image.shape[:2]) == 64
        assert mask.shape == image.shape[:2]
