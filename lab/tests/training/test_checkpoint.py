from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from deepdetect import WeightsError
from deepdetect_lab.training.checkpoint import (
    read_checkpoint,
    restore,
    save_checkpoint,
)
from deepdetect_lab.training.optim import make_optimizers


def small_network(channels: int = 4) -> torch.nn.Module:
    torch.manual_seed(0)
    network = torch.nn.Sequential(
        torch.nn.Conv2d(3, channels, 3), torch.nn.BatchNorm2d(channels), torch.nn.PReLU(channels)
    )
    return network.to(memory_format=torch.channels_last)


def trained(
    optimizer: str = "adam", steps: int = 1
) -> tuple[torch.nn.Module, torch.nn.Module, list[torch.optim.Optimizer]]:
    network = small_network()
    optimizers = make_optimizers(optimizer, network)
    for _ in range(steps):
        network(torch.rand(2, 3, 8, 8)).square().mean().backward()
        for each in optimizers:
            each.step()
    return network, small_network(), optimizers


@pytest.mark.parametrize("optimizer", ["adam", "soap"])
def test_a_checkpoint_gives_everything_back(tmp_path: Path, optimizer: str) -> None:
    network, average, optimizers = trained(optimizer)
    torch.nn.init.normal_(average[0].weight)
    path = tmp_path / "c.safetensors"
    save_checkpoint(path, network, average, optimizers, {"step": 1})
    other, other_average, other_optimizers = trained(optimizer, steps=0)
    tensors, metadata = read_checkpoint(path)
    assert metadata == {"step": 1}
    restore(tensors, other, other_average, other_optimizers)
    assert torch.equal(other_average[0].weight, average[0].weight)
    for name, value in network.state_dict().items():
        assert torch.equal(value, other.state_dict()[name])
    for ours, theirs in zip(optimizers, other_optimizers, strict=True):
        for a, b in zip(
            ours.param_groups[0]["params"], theirs.param_groups[0]["params"], strict=True
        ):
            assert ours.state[a].keys() == theirs.state[b].keys()
            for moment, value in ours.state[a].items():
                assert torch.equal(value, theirs.state[b][moment])
                if value.shape == a.shape:
                    assert theirs.state[b][moment].stride() == b.stride()


@pytest.mark.parametrize("content", [b"", b"no checkpoint", b"\x80\x04K\x01."])
def test_a_damaged_checkpoint_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "checkpoint.safetensors"
    path.write_bytes(content)
    with pytest.raises(WeightsError):
        read_checkpoint(path)


def test_altered_tensors_and_states_are_refused(tmp_path: Path) -> None:
    """A fused optimiser writes beyond a moment of another shape, and crashes Python."""
    path = tmp_path / "c.safetensors"
    save_checkpoint(path, *trained(), {"step": 1})
    tensors = load_file(path)
    with safe_open(path, framework="pt") as file:
        header = file.metadata()
    shorter = {**tensors, "optimizer.exp_avg.0.weight": torch.zeros(3)}
    for values, changed in (
        (tensors, {**header, "state": '{"step": 2}'}),
        (shorter, header),
        (tensors, {}),
    ):
        save_file(values, path, metadata=changed)
        with pytest.raises(WeightsError, match=path.name):
            read_checkpoint(path)
    save_file(tensors, path, metadata=header)
    assert read_checkpoint(path)[1] == {"step": 1}
