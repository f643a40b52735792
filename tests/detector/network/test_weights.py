from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

torch = pytest.importorskip("torch", reason="needs torch, which is for training only")

from deepdetect import OptionError, WeightsError  # noqa: E402
from deepdetect.detector.network.weights import (  # noqa: E402
    NETWORKS,
    average_weights,
    load_network,
    save_tensors,
)
from deepdetect.detector.pretrained import pretrained_weights  # noqa: E402
from deepdetect.training import TrainingOptions  # noqa: E402
from deepdetect.training.dense import initial_network  # noqa: E402


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
    fast, espnet = fast_files[1], pretrained_weights("espnet", ".safetensors")
    with pytest.raises(WeightsError):
        average_weights([espnet, fast])
    with pytest.raises(OptionError, match="espnet"):
        initial_network(TrainingOptions(network="espnet"), fast)
    start = initial_network(TrainingOptions(network="fast"), [fast, fast])[1]
    assert type(start) is NETWORKS["fast"]
