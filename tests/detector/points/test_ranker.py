from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from deepdetect._shared.errors import WeightsError
from deepdetect.detector.points.candidate_features import FEATURES
from deepdetect.detector.points.ranker import Ranker, load_ranker
from deepdetect.detector.pretrained import RANKER


def arrays(**changes) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    shapes = {
        "mean": (FEATURES,),
        "deviation": (FEATURES,),
        "weight0": (5, FEATURES),
        "bias0": (5,),
        "weight1": (4, 5),
        "bias1": (4,),
        "weight2": (1, 4),
        "bias2": (1,),
    }
    found = {name: rng.random(shape).astype(np.float32) + 0.5 for name, shape in shapes.items()}
    return {**found, "notes": np.array("{}"), **changes}


def test_the_logit_is_the_first_feature_and_a_perceptron(tmp_path: Path) -> None:
    values = arrays()
    np.savez(tmp_path / "a.npz", **values)
    features = np.random.default_rng(1).normal(0, 3, (7, FEATURES)).astype(np.float32)
    x = np.clip((features - values["mean"]) / values["deviation"], -6, 6)
    x = np.maximum(x @ values["weight0"].T + values["bias0"], 0)
    x = np.maximum(x @ values["weight1"].T + values["bias1"], 0)
    wanted = features[:, 0] + (x @ values["weight2"].T + values["bias2"])[:, 0]
    np.testing.assert_allclose(load_ranker(tmp_path / "a.npz").rank(features), wanted, rtol=1e-5)


def test_the_ranker_in_the_package_is_small_and_says_where_it_is_from() -> None:
    ranker = load_ranker()
    assert isinstance(ranker, Ranker)
    assert sum(w.size + b.size for w, b in ranker.layers) < 30_000
    assert RANKER.stat().st_size < 100_000
    notes = json.loads(ranker.notes)
    assert json.loads(str(notes["options"]))["seed"] == 0
    assert notes["photographs"] == 2705


@pytest.mark.parametrize(
    "changes",
    [
        {"weight0": np.zeros((5, FEATURES - 1), np.float32)},
        {"weight2": np.zeros((2, 4), np.float32), "bias2": np.zeros(2, np.float32)},
        {"bias1": np.full(4, np.nan, np.float32)},
        {"mean": np.zeros(3, np.float32)},
    ],
)
def test_another_network_is_reported(tmp_path: Path, changes) -> None:
    np.savez(tmp_path / "a.npz", **arrays(**changes))
    with pytest.raises(WeightsError, match=r"a\.npz"):
        load_ranker(tmp_path / "a.npz")


def test_damaged_and_missing_files_are_reported(tmp_path: Path) -> None:
    with pytest.raises(WeightsError):
        load_ranker(tmp_path / "none.npz")
    np.savez(tmp_path / "a.npz", **arrays())
    whole = (tmp_path / "a.npz").read_bytes()
    cases = (b"", b"nonsense", whole[:200], whole[: len(whole) // 2])
    for k, data in enumerate(cases):
        path = tmp_path / f"{k}.npz"
        path.write_bytes(data)
        with pytest.raises(WeightsError):
            load_ranker(path)
    np.savez(tmp_path / "pickle.npz", **arrays(notes=np.array([{}], object)))
    with pytest.raises(WeightsError):
        load_ranker(tmp_path / "pickle.npz")


def test_an_array_and_damage_of_any_kind_are_reported(tmp_path: Path) -> None:
    np.save(tmp_path / "array.npy", np.zeros(3))
    with pytest.raises(WeightsError):
        load_ranker(tmp_path / "array.npy")
    np.savez_compressed(tmp_path / "a.npz", **arrays())
    load_ranker(tmp_path / "a.npz")
    whole = (tmp_path / "a.npz").read_bytes()
    damaged = tmp_path / "damaged.npz"
    for place in range(60, len(whole) // 2, 40):  # of compressed numbers, mostly
        damaged.write_bytes(whole[:place] + bytes(20) + whole[place + 20 :])
        with pytest.raises(WeightsError):
            load_ranker(damaged)
