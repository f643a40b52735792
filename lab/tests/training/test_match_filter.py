from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime
import pytest
import torch
from skimage import data

from deepdetect.features.learned import LEARNED
from deepdetect.features.sift import ROOT_SIFT
from deepdetect_lab.networks.weights import load_network
from deepdetect_lab.training import MatchFilterTrainingOptions, match_filter
from deepdetect_lab.training.match_filter import (
    RIGHT_PX,
    UNRELATED,
    MatchFilter,
    MatchFilterTrainer,
    Sample,
    draw_sample,
    join,
    vary,
)


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> list[Sample]:
    files = [tmp_path_factory.mktemp("large") / f"{k}.png" for k in range(3)]
    for file, photograph in zip(files, (data.astronaut, data.coffee, data.chelsea), strict=True):
        large = cv2.resize(photograph(), (960, 960), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(file), large)
    return [draw_sample(files, 0, number) for number in range(8)]


def test_samples_know_which_matches_are_right(samples: list[Sample]) -> None:
    shares = [np.mean(errors < RIGHT_PX) for _, errors in samples]
    assert np.median(shares[1:UNRELATED]) > 0.2
    assert shares[0] == shares[UNRELATED] == 0
    for values, errors in samples:
        assert len({len(each) for each in (*values.values(), errors)}) == 1


def test_what_is_right_lies_alike_after_it_is_varied(samples: list[Sample]) -> None:
    rng, turns, growths = np.random.default_rng(0), [], []
    for k in range(40):
        values, errors = vary(rng, samples[1 + k % 6])
        first, second = values["xy0"], values["xy1"]
        right = np.flatnonzero(errors < RIGHT_PX)
        if len(right) < 20:
            continue
        fitted, inliers = cv2.estimateAffine2D(first[right], second[right], None, cv2.RANSAC, 8)
        alike = right[inliers.ravel() > 0]  # of one part of the photograph
        # Keypoints turn and grow as the images do.
        turn = np.arctan2(fitted[1, 0] - fitted[0, 1], fitted[0, 0] + fitted[1, 1])
        turns.append((np.median(values["turns"][alike]) - turn + np.pi) % (2 * np.pi) - np.pi)
        growth = np.median(np.log(values["sizes1"] / values["sizes0"])[alike])
        growths.append(growth - np.log(abs(np.linalg.det(fitted[:, :2]))) / 2)
    assert len(turns) > 10
    assert np.quantile(np.abs(turns), 0.8) < 0.3
    assert np.quantile(np.abs(growths), 0.8) < 0.3


def test_it_learns_and_its_file_does_the_same(
    samples: list[Sample], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(match_filter, "draw_samples", lambda *_: samples)
    options = MatchFilterTrainingOptions(steps=40, val_count=2)
    trainer = MatchFilterTrainer([], [], options)
    result = trainer.fit(tmp_path)
    network: Any = load_network(result.weights, MatchFilter)
    values, errors = join(samples)
    with torch.no_grad():
        logits = network(*values).numpy()
    right, wrong = logits[errors.numpy() < RIGHT_PX], logits[errors.numpy() > 2 * RIGHT_PX]
    assert (right[:, None] > wrong[::9]).mean() > 0.8
    assert [point["step"] for point in result.points] == [20, 40]
    assert result.best["validation_loss"] == result.points[1]["validation_loss"]
    assert "| rootsift, filter, as precise: right |" in (tmp_path / "MODEL_CARD.md").read_text()

    numbers = np.repeat(np.arange(len(samples)), [len(each) for _, each in samples])
    unrelated = np.isin(numbers, (0, UNRELATED))
    found = [result.best[f"{name}, filter: of unrelated views"] for name in (LEARNED, ROOT_SIFT)]
    assert sum(found) == (logits[unrelated] > 0).sum()
    session = onnxruntime.InferenceSession(result.onnx)
    values, _ = join(samples[2:5])
    given = {
        each.name: value.numpy() for each, value in zip(session.get_inputs(), values, strict=True)
    }
    with torch.no_grad():
        expected = network(*values).numpy()
    np.testing.assert_allclose(session.run(None, given)[0], expected, atol=1e-4)


def test_batches_are_functions_of_the_step(
    samples: list[Sample], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(match_filter, "draw_samples", lambda *_: samples)
    trainer = MatchFilterTrainer([], [], MatchFilterTrainingOptions(steps=3))
    every = list(trainer.loader())
    (values, errors), *_ = trainer.loader(2)
    assert len(every) == 3
    assert torch.equal(errors, every[2][1])
    assert all(map(torch.equal, values, every[2][0]))
