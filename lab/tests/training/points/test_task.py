from __future__ import annotations

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from deepdetect.detector.points.detection import detect_points
from deepdetect.detector.points.ranker import load_ranker
from deepdetect.features.keypoints import Keypoints
from deepdetect.io.image import find_images
from deepdetect_lab.training import PointsTrainingOptions, TrainingResult, train_on_pairs
from deepdetect_lab.training.checkpoint import read_checkpoint
from deepdetect_lab.training.points.measure import MEASURES, measure, validation_pairs
from deepdetect_lab.training.points.task import RankerTrainer
from deepdetect_lab.training.trainer import CHECKPOINT

OPTIONS = PointsTrainingOptions(steps=2, pairs=1, side=64, val_count=1, val_pairs=1)


@pytest.fixture(scope="module", autouse=True)
def few_and_small() -> Iterator[None]:
    """Measure few pairs, and small ones, which is faster."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("deepdetect_lab.training.points.measure.SIDE_PX", 64)
        patch.setattr("deepdetect_lab.training.points.task.STATISTICS_PAIRS", 2)
        patch.setattr("deepdetect_lab.training.trainer.CHECKPOINT_INTERVAL_S", 0)
        yield


def run(textures: Path, folder: Path) -> TrainingResult:
    return train_on_pairs(textures, textures, folder, OPTIONS)


@pytest.fixture(scope="module")
def whole(textures: Path, tmp_path_factory) -> TrainingResult:
    return run(textures, tmp_path_factory.mktemp("whole"))


@pytest.fixture(scope="module")
def untrained(textures: Path) -> RankerTrainer:
    """As it is before the first step; the caller keeps its random numbers."""
    torch.manual_seed(3)
    expected = torch.rand(4)
    torch.manual_seed(3)
    made = RankerTrainer(*[find_images(textures)] * 2, OPTIONS)
    assert torch.equal(torch.rand(4), expected)
    return made


def interrupted(monkeypatch: pytest.MonkeyPatch, count: int) -> Any:
    calls = iter(range(count))
    step = RankerTrainer.training_step

    def training_step(*arguments: Any) -> float:
        if next(calls, None) is None:
            raise KeyboardInterrupt
        return step(*arguments)

    monkeypatch.setattr(RankerTrainer, "training_step", training_step)
    return pytest.raises(KeyboardInterrupt)


def same_state(a: Path, b: Path) -> bool:
    first, second = (load_file(folder / CHECKPOINT) for folder in (a, b))
    return first.keys() == second.keys() and all(torch.equal(first[k], second[k]) for k in first)


def test_training_changes_the_weights_and_measures(
    whole: TrainingResult, untrained: RankerTrainer
) -> None:
    after = load_file(whole.weights.parent / CHECKPOINT)
    assert all((after[f"network.{n}"] != p).any() for n, p in untrained.network.named_parameters())
    assert [point["step"] for point in whole.points] == [0, 2]
    assert whole.best["score"] == max(point["score"] for point in whole.points)
    assert (whole.weights.parent / "MODEL_CARD.md").is_file()


def test_an_interrupted_run_ends_with_the_same_weights(
    whole: TrainingResult, textures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch, interrupted(patch, 1):
        run(textures, tmp_path)
    assert read_checkpoint(tmp_path / CHECKPOINT)[1]["step"] == 1
    assert run(textures, tmp_path).points == whole.points
    assert same_state(tmp_path, whole.weights.parent)


def test_the_best_weights_are_those_of_the_best_measure(
    whole: TrainingResult, textures: Path
) -> None:
    ranker = load_ranker(whole.weights)
    found = measure(
        partial(detect_points, ranker=ranker), validation_pairs(find_images(textures), 1)
    )
    assert found["score"] == pytest.approx(whole.best["score"], abs=1e-6)
    notes = json.loads(ranker.notes)
    assert notes["images"] == "4"
    assert json.loads(notes["point"]) == whole.best


def test_an_untrained_ranker_ranks_by_the_first_feature(untrained: RankerTrainer) -> None:
    module = untrained.network
    features = module.mean + module.deviation * torch.randn(
        200, len(module.mean), generator=torch.Generator().manual_seed(1)
    )
    logits = module(features)
    correlation = torch.corrcoef(torch.stack([logits.detach(), features[:, 0]]))[0, 1]
    assert correlation > 0.999
    exported = module.export({"a": 1})
    np.testing.assert_allclose(exported.rank(features.numpy()), logits.detach().numpy(), atol=1e-5)


def test_the_measure_of_a_blind_detector(textures: Path) -> None:
    pairs = validation_pairs(find_images(textures), 2)
    assert {pair.kind for pair in pairs} == {"zoom", "blur", "viewpoint", "light"}
    generator = np.random.default_rng(0)

    def blind(image: np.ndarray) -> Keypoints:
        return Keypoints(generator.uniform(0, 63, (500, 2)), generator.random(500), (64, 64))

    found = measure(blind, pairs)
    assert len(found) == 1 + 4 * len(MEASURES)
    assert found["score"] < 0.3
    assert max(found[name] for name in found if name.endswith("correct")) < 0.1
    assert found["blur @3 px 2048"] >= found["blur @1 px 2048"]
