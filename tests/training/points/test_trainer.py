from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from deepdetect._shared.errors import OptionError, WeightsError
from deepdetect.training.points.measure import measure
from deepdetect.training.points.recipe import PointsTrainingOptions
from deepdetect.training.points.trainer import BEST, PointsTrainer, load_head

OPTIONS = PointsTrainingOptions(steps=4, pairs=1, side=64, levels=2, warm_up=1)


def trainer(textures: Path, folder: Path, options=OPTIONS, **settings) -> PointsTrainer:
    settings = {"measure_every": 2, "save_every": 1, "pairs_per_kind": 1, **settings}
    return PointsTrainer(textures, textures, folder, options, **settings)


def weights(run: PointsTrainer) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in run.head.parameters()])


@pytest.fixture(scope="module")
def whole(textures: Path, tmp_path_factory) -> PointsTrainer:
    run = trainer(textures, tmp_path_factory.mktemp("whole"))
    run.fit()
    return run


def test_training_changes_the_weights_and_measures(
    whole: PointsTrainer, textures, tmp_path
) -> None:
    start = trainer(textures, tmp_path)
    assert (weights(start) != weights(whole)).any()
    assert [point["step"] for point in whole.state.points] == [0, 2, 4]
    best = max(point["score"] for point in whole.state.points)
    assert whole.state.best_score == best


def test_an_interrupted_run_ends_with_the_same_weights(whole, textures, tmp_path) -> None:
    trainer(textures, tmp_path).fit(last_step=3)
    resumed = trainer(textures, tmp_path)
    assert resumed.state.step == 3
    resumed.fit()
    torch.testing.assert_close(weights(resumed), weights(whole), rtol=0, atol=0)
    torch.testing.assert_close(
        resumed.average.state_dict(), whole.average.state_dict(), rtol=0, atol=0
    )
    scores = [[point["score"] for point in run.state.points] for run in (resumed, whole)]
    assert scores[0] == scores[1]


def test_the_best_weights_are_those_of_the_best_measure(whole: PointsTrainer) -> None:
    head = load_head(whole.folder / BEST)
    from deepdetect.training.points.measure import head_detector

    found = measure(head_detector(head, whole._pyramid()), whole.pairs)
    assert found.score == pytest.approx(whole.state.best_score)


def test_other_options_do_not_resume(whole: PointsTrainer, textures) -> None:
    with pytest.raises(OptionError, match="other options"):
        trainer(textures, whole.folder, dataclasses.replace(OPTIONS, seed=1))


def test_a_file_of_something_else_is_reported(tmp_path: Path) -> None:
    (tmp_path / "a.safetensors").write_bytes(b"nonsense")
    with pytest.raises(WeightsError, match=r"a\.safetensors"):
        load_head(tmp_path / "a.safetensors")


@pytest.mark.parametrize(
    "change", [{"loss": "budgt"}, {"steps": 0}, {"min_density": 0}, {"kind_weights": (1, 1)}]
)
def test_wrong_options_are_reported(change) -> None:
    with pytest.raises(OptionError):
        dataclasses.replace(OPTIONS, **change)


def test_the_measure_of_a_perfect_and_of_a_blind_detector(textures: Path) -> None:
    from deepdetect.features.keypoints import Keypoints
    from deepdetect.training.points.measure import validation_pairs

    pairs = validation_pairs(textures, 2, side=96)
    assert {pair.kind for pair in pairs} == {"zoom", "blur", "viewpoint", "light"}
    generator = np.random.default_rng(0)

    def blind(image: np.ndarray) -> Keypoints:
        return Keypoints(generator.uniform(0, 95, (500, 2)), generator.random(500), (96, 96))

    found = measure(blind, pairs)
    assert found.mean.shape == (2, 2)
    assert found.score < 0.25
    assert (found.mean[:, 1] >= found.mean[:, 0]).all()
