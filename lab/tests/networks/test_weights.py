from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import torch

from deepdetect import OptionError, WeightsError
from deepdetect.detector.pretrained import PRETRAINED
from deepdetect_lab.networks.weights import (
    NETWORKS,
    average_weights,
    find_weights,
    load_network,
    read_notes,
    save_tensors,
)
from deepdetect_lab.training import TrainingOptions
from deepdetect_lab.training.dense import initial_network


@pytest.mark.parametrize("name", NETWORKS)
def test_a_file_says_by_its_tensors_of_which_network_it_is(name: str, tmp_path: Path) -> None:
    network, path = NETWORKS[name](), tmp_path / "weights.safetensors"
    save_tensors(network.state_dict(), path, {})
    loaded = load_network(path)
    assert type(loaded) is NETWORKS[name]
    for key, value in network.state_dict().items():
        assert torch.equal(value, loaded.state_dict()[key])


def test_weights_with_a_tensor_of_another_shape_are_refused(
    fast_network: Any, tmp_path: Path
) -> None:
    state = fast_network.state_dict() | {"logits.bias": torch.zeros(5)}
    save_tensors(state, tmp_path / "weights.safetensors", {})
    with pytest.raises(WeightsError, match=r"logits\.bias"):
        load_network(tmp_path / "weights.safetensors")


def test_networks_are_not_mixed(fast_files: tuple[Path, Path], tmp_path: Path) -> None:
    fast, espnet = fast_files[1], find_weights("espnet")
    with pytest.raises(WeightsError, match="another network"):
        average_weights([espnet, fast])
    with pytest.raises(OptionError, match="espnet"):
        initial_network(TrainingOptions(network="espnet"), fast)
    start = initial_network(TrainingOptions(network="fast"), [fast, fast])[1]
    assert type(start) is NETWORKS["fast"]


@pytest.mark.parametrize("name", PRETRAINED)
def test_weights_tell_where_they_come_from(name: str) -> None:
    means, runs = [], []
    found = [read_notes(find_weights(name))]
    while found:  # a mean's parts may be means
        notes = found.pop()
        (means if "parts" in notes else runs).append(notes)
        found += json.loads(notes.get("parts", "[]"))
        found += [json.loads(notes["begun_with"])] if "begun_with" in notes else []
    assert runs
    # No weights that have seen other photographs stand behind those of free licences.
    assert name != "free" or (not means and not any(" --init" in one["command"] for one in runs))
    for mean in means:
        assert re.match("deepdetect (dev )?average ", mean["command"])
    for run in runs:
        assert run["command"].startswith(("deepdetect train ", "python benchmarks/fast_network/"))
        for word in ("photographs_digest", "versions", "machine", "start", "point"):
            assert run[word]
    for one in (*means, *runs):
        assert " /" not in one["command"], "no folder of one machine"
        assert len(one["commit"]) == 40
