from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import pytest
import torch

from deepdetect import OptionError
from deepdetect_lab.training import MatcherTrainingOptions
from deepdetect_lab.training.matcher import task
from deepdetect_lab.training.matcher.network import OUTPUTS, Matcher, export_matcher
from deepdetect_lab.training.matcher.pairs import NONE, UNKNOWN, Pair
from deepdetect_lab.training.matcher.task import MatcherTrainer, as_tensors, loss_of, vary


def made_pair(seed: int, count: int = 60) -> Pair:
    """A pair whose second image is the first, shifted; a third of the keypoints has no partner."""
    rng = np.random.default_rng(seed)
    inputs, order = {}, rng.permutation(count)
    described = rng.standard_normal((count, 64))
    xy = rng.uniform(-1, 1, (count, 2))
    for side in (0, 1):
        rows = order if side else np.arange(count)
        own = described + (0.3 * rng.standard_normal((count, 64)) if side else 0)
        own[: count // 3] = rng.standard_normal((count // 3, 64)) if side else own[: count // 3]
        own = (own / np.linalg.norm(own, axis=1, keepdims=True))[rows]
        inputs[f"xy{side}"] = (xy + 0.1 * side)[rows].astype(np.float32)
        inputs[f"descriptors{side}"] = own.astype(np.float16)
        inputs[f"traits{side}"] = np.zeros((count, 4), np.float32)
    partners0 = np.argsort(order)
    partners0[: count // 3] = NONE
    partners1 = np.where(order < count // 3, NONE, order)
    return Pair(inputs, partners0.astype(np.int16), partners1.astype(np.int16))


def places_of(folder: Path) -> Path:
    """Make a folder of places with a photograph of each kind."""
    for kind in ("fixed", "moving"):
        place = folder / "places" / kind / "one"
        place.mkdir(parents=True)
        cv2.imwrite(str(place / "0.png"), np.zeros((20, 20), np.uint8))
    return folder / "places"


def test_varied_pairs_have_the_same_partners() -> None:
    pair = made_pair(0)
    pair.partners1[pair.partners0[30]] = UNKNOWN
    pair.partners0[30] = UNKNOWN
    counts = []
    for seed in range(20):
        inputs, partners0, partners1 = vary(np.random.default_rng(seed), pair)
        rows = np.flatnonzero(partners0 >= 0)
        np.testing.assert_array_equal(partners1[partners0[rows]], rows)
        offsets = inputs["xy1"][partners0[rows]] - inputs["xy0"][rows]
        assert len(rows) < 2 or np.ptp(offsets, axis=0).max() < 1e-4  # one shift, turned and zoomed
        counts.append(len(rows))
    assert max(counts) > 5


def test_the_loss_is_that_of_the_right_assignment() -> None:
    class Known(Matcher):
        def forward(self, *_: torch.Tensor, **__: torch.Tensor) -> tuple[torch.Tensor, ...]:  # type: ignore[override]
            return torch.log(torch.tensor([[0.5, 0.1], [0.1, 0.2]])), torch.zeros(2), torch.ones(2)

    loss, _ = loss_of(Known(), {}, torch.tensor([0, NONE]), torch.tensor([0, UNKNOWN]))
    assert loss.item() == pytest.approx((np.log(2) + np.log(2)) / 2)


def test_it_learns_and_its_file_does_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pairs = {Path(str(seed)): made_pair(seed) for seed in range(12)}
    monkeypatch.setattr(task, "draw_pairs", lambda *_, **__: [*pairs])
    monkeypatch.setattr(task, "read_pair", lambda path: pairs[path])
    options = MatcherTrainingOptions(steps=60, val_count=2, learning_rate=2e-3)
    trainer = MatcherTrainer([], [], options, tmp_path)
    before = trainer.validate(0)["validation_loss"]
    result = trainer.fit(tmp_path)
    with pytest.raises(OptionError, match="places"):
        MatcherTrainer([], [], options, tmp_path, places_of(tmp_path)).fit(tmp_path)
    assert result.best["validation_loss"] < before - 0.5
    inputs, _, _ = as_tensors(made_pair(20))
    with torch.no_grad():
        scores = trainer.average(**inputs)[0]
    export_matcher(trainer.average, tmp_path / "last.onnx")
    session = onnxruntime.InferenceSession(tmp_path / "last.onnx")
    found = session.run(list(OUTPUTS), {name: each.numpy() for name, each in inputs.items()})
    np.testing.assert_array_equal(found[0], scores.argmax(1))
    np.testing.assert_allclose(found[1], scores.max(1).values.exp(), rtol=1e-3, atol=1e-5)
    np.testing.assert_array_equal(found[2], scores.argmax(0))
