from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from deepdetect._shared.errors import OptionError, WeightsError
from deepdetect.detector.points.ranker import load_ranker, notes_of
from deepdetect.training.checkpoint import read_checkpoint
from deepdetect.training.points.measure import measure, points_detector
from deepdetect.training.points.recipe import PointsTrainingOptions
from deepdetect.training.points.trainer import BEST, CHECKPOINT, PointsState, PointsTrainer

OPTIONS = PointsTrainingOptions(steps=4, pairs=1, side=96, hidden=(6, 4), warm_up=1)


@pytest.fixture(scope="module", autouse=True)
def few_statistics() -> Iterator[None]:
    """Take mean and deviation of the features from a few pairs, which is faster."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("deepdetect.training.points.trainer.STATISTICS_PAIRS", 4)
        yield


def trainer(textures: Path, folder: Path, options=OPTIONS, **settings) -> PointsTrainer:
    settings = {"measure_every": 2, "save_every": 1, "pairs_per_kind": 1, **settings}
    return PointsTrainer(textures, textures, folder, options, **settings)


def weights(run: PointsTrainer) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in run.ranker.parameters()])


@pytest.fixture(scope="module")
def whole(textures: Path, tmp_path_factory) -> PointsTrainer:
    run = trainer(textures, tmp_path_factory.mktemp("whole"))
    run.fit()
    return run


def test_training_changes_the_weights_and_measures(
    whole: PointsTrainer, textures, tmp_path
) -> None:
    torch.manual_seed(3)
    expected = torch.rand(4)
    torch.manual_seed(3)
    start = trainer(textures, tmp_path)
    assert torch.equal(torch.rand(4), expected), "the caller keeps its random numbers"
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
    ranker = load_ranker(whole.folder / BEST)
    found = measure(points_detector(ranker), whole.pairs)
    assert found.score == pytest.approx(whole.state.best_score, abs=1e-6)
    notes = notes_of(ranker)
    assert notes["photographs"] == 4
    assert notes["point"]["score"] == whole.state.best_score


def test_an_untrained_ranker_ranks_by_the_first_feature(textures, tmp_path) -> None:
    module = trainer(textures, tmp_path).ranker
    features = module.mean + module.deviation * torch.randn(
        200, len(module.mean), generator=torch.Generator().manual_seed(1)
    )
    logits = module(features)
    correlation = torch.corrcoef(torch.stack([logits.detach(), features[:, 0]]))[0, 1]
    assert correlation > 0.999
    exported = module.export({"a": 1})
    np.testing.assert_allclose(exported.rank(features.numpy()), logits.detach().numpy(), atol=1e-5)


def test_other_options_do_not_resume(whole: PointsTrainer, textures) -> None:
    with pytest.raises(OptionError, match="other options"):
        trainer(textures, whole.folder, dataclasses.replace(OPTIONS, seed=1))


@pytest.mark.parametrize(
    "change",
    [
        {"hidden": (0, 4)},
        {"steps": 0},
        {"min_density": 0},
        {"kind_weights": (1, 1)},
        {"close_share": 2},
        {"match_weight": -1},
    ],
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
    assert found.mean.shape == (3, 2)
    assert found.score < 0.3
    assert found.mean_correct < 0.05
    assert (found.mean[:, 1] >= found.mean[:, 0]).all()


@pytest.mark.parametrize(
    "change",
    [
        {"step": -1},
        {"step": 10**9},
        {"step": "4"},
        {"step": None},
        {"loss_count": 0.5},
        {"loss_sum": "0"},
        {"seconds": 10**400},
        {"best_score": None},
        {"best_score": float("nan")},
        {"points": None},
        {"points": []},
        {"points": [3]},
        {"points": [{"step": 0}]},
    ],
)
def test_an_impossible_state_is_refused(change, whole: PointsTrainer) -> None:
    stored = read_checkpoint(whole.folder / CHECKPOINT).metadata
    assert PointsState.from_json(stored, last_step=4) == whole.state
    missing = {name: value for name, value in stored.items() if name not in change}
    for state in ({**stored, **change}, missing):
        with pytest.raises(ValueError, match=f"{next(iter(change))}|point|loss"):
            PointsState.from_json(state, last_step=4)


@pytest.mark.parametrize("kind", ["short", "twice", "words"])
def test_altered_rows_of_measures_are_refused(kind: str, whole: PointsTrainer) -> None:
    stored = read_checkpoint(whole.folder / CHECKPOINT).metadata
    rows = stored["points"]
    if kind == "short":
        rows[0]["zoom"].pop()
    elif kind == "twice":
        rows.append(rows[-1])
    else:
        rows[0]["light"][0] = "0.5"
    with pytest.raises(ValueError, match=r"zoom|points|light"):
        PointsState.from_json(stored, last_step=4)


def test_an_altered_checkpoint_is_one_sentence(
    whole: PointsTrainer, textures: Path, tmp_path: Path, one_line
) -> None:
    found = read_checkpoint(whole.folder / CHECKPOINT)
    moment = "optimizer.exp_avg_sq.ranker.first.weight"
    for state, tensors, told in (
        ({"step": None}, {}, "step"),
        ({}, {moment: torch.zeros(3)}, moment),
    ):
        save_file(
            {**found.tensors, **tensors},
            tmp_path / CHECKPOINT,
            metadata={"state": json.dumps({**found.metadata, **state})},
        )
        with pytest.raises(WeightsError, match="delete it, or train into another") as caught:
            trainer(textures, tmp_path)
        assert str(tmp_path / CHECKPOINT) in one_line(caught.value)
        assert told in str(caught.value)


@pytest.mark.parametrize(("last_step", "content"), [(3, b"damaged"), (4, None)])
def test_damaged_best_weights_do_not_stop_a_run(
    last_step: int, content, whole: PointsTrainer, textures: Path, tmp_path: Path, capsys
) -> None:
    trainer(textures, tmp_path).fit(last_step=last_step)
    if content is None:  # without what is known of it
        with np.load(tmp_path / BEST) as file:
            arrays = dict(file)
        np.savez(tmp_path / BEST, **{**arrays, "notes": np.array("{}")})
    else:
        (tmp_path / BEST).write_bytes(content)
    resumed = trainer(textures, tmp_path, quiet=False)
    assert f"{tmp_path / BEST} is missing or damaged" in "".join(capsys.readouterr())
    resumed.fit()
    assert notes_of(load_ranker(tmp_path / BEST))["point"]["step"] == 4
    assert resumed.state.best_score == whole.state.points[-1]["score"]
    torch.testing.assert_close(weights(resumed), weights(whole), rtol=0, atol=0)
