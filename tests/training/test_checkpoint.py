from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

torch = pytest.importorskip("torch", reason="needs torch, which is for training only")


from deepdetect import WeightsError  # noqa: E402
from deepdetect.training.checkpoint import (  # noqa: E402
    Checkpoint,
    TrainingState,
    read_checkpoint,
    save_checkpoint,
)
from deepdetect.training.optim import make_optimizers  # noqa: E402

POINT = {"step": 10, "training_loss": 0.5, "score": 0.4}
STATE = TrainingState(12, 0.7, 2, [POINT])
COLUMNS = tuple(POINT)


def small_network(channels: int = 4) -> torch.nn.Module:
    torch.manual_seed(0)
    network = torch.nn.Sequential(
        torch.nn.Conv2d(3, channels, 3), torch.nn.BatchNorm2d(channels), torch.nn.PReLU(channels)
    )
    return network.to(memory_format=torch.channels_last)


def trained(
    optimizer: str = "adam", steps: int = 1
) -> tuple[torch.nn.Module, list[torch.optim.Optimizer]]:
    network = small_network()
    optimizers = make_optimizers(optimizer, network)
    for _ in range(steps):
        network(torch.rand(2, 3, 8, 8)).square().mean().backward()
        for each in optimizers:
            each.step()
    return network, optimizers


@pytest.mark.parametrize("optimizer", ["adam", "soap"])
def test_a_checkpoint_gives_everything_back(tmp_path: Path, optimizer: str) -> None:
    network, optimizers = trained(optimizer)
    path = tmp_path / "c.safetensors"
    save_checkpoint(path, network, optimizers, {"step": 1})
    other, other_optimizers = trained(optimizer, steps=0)
    found = read_checkpoint(path)
    assert found.metadata == {"step": 1}
    found.restore(other, other_optimizers)
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
def test_a_damaged_checkpoint_is_refused(tmp_path: Path, content: bytes, one_line) -> None:
    path = tmp_path / "checkpoint.safetensors"
    path.write_bytes(content)
    with pytest.raises(WeightsError, match="delete it") as caught:
        read_checkpoint(path)
    one_line(caught.value)


def _shorter(tensors: dict[str, torch.Tensor], name: str) -> None:
    tensors[name] = torch.zeros(3)


def _doubled(tensors: dict[str, torch.Tensor], name: str) -> None:
    tensors[name] = tensors[name].double()


def _missing(tensors: dict[str, torch.Tensor], name: str) -> None:
    del tensors[name]


def _not_finite(tensors: dict[str, torch.Tensor], name: str) -> None:
    tensors[name] = torch.full_like(tensors[name], float("nan"))


def _negative(tensors: dict[str, torch.Tensor], name: str) -> None:
    tensors[name] = torch.full_like(tensors[name], -1)


@pytest.mark.parametrize(
    ("optimizer", "name", "change"),
    [
        ("adam", "optimizer.exp_avg.0.weight", _shorter),
        ("adam", "optimizer.step.0.weight", _doubled),
        ("adam", "optimizer.step.0.weight", _negative),
        ("soap", "optimizer.right_basis.0.weight", _missing),
        ("adam", "network.0.weight", _not_finite),
    ],
)
def test_a_tensor_that_does_not_fit_is_refused_before_an_optimizer_sees_it(
    tmp_path: Path, optimizer: str, name: str, change: Callable[..., None], one_line
) -> None:
    """A fused optimiser writes beyond a moment of another shape, and crashes Python."""
    path = tmp_path / "c.safetensors"
    network, optimizers = trained(optimizer)
    save_checkpoint(path, network, optimizers, {})
    tensors = dict(read_checkpoint(path).tensors)
    change(tensors, name)
    other, other_optimizers = trained(optimizer, steps=0)
    before = {key: value.clone() for key, value in other.state_dict().items()}
    with pytest.raises(WeightsError, match=name) as caught:
        Checkpoint(path, {}, tensors).restore(other, other_optimizers)
    one_line(caught.value)
    assert all(torch.equal(value, before[key]) for key, value in other.state_dict().items())
    assert not any(each.state for each in other_optimizers)


def state_of(**changes: Any) -> TrainingState:
    metadata = json.loads(json.dumps({**dataclasses.asdict(STATE), **changes}))
    return Checkpoint(Path("c.safetensors"), metadata, {}).state(12, COLUMNS)


def test_the_state_of_a_run_is_given_back() -> None:
    assert state_of() == STATE


@pytest.mark.parametrize(
    "change",
    [
        {"step": -1},
        {"step": 13},
        {"step": 1.5},
        {"loss_sum": 10**400},
        {"loss_sum": float("nan")},
        {"loss_sum": "0.7"},
        {"loss_count": None},
        {"points": None},
        {"points": [None]},
        {"points": [{"step": 1}]},
        {"points": [{**POINT, "score": "1"}]},
    ],
)
def test_an_impossible_state_is_refused(change: dict[str, Any], one_line) -> None:
    with pytest.raises(WeightsError, match="delete it") as caught:
        state_of(**change)
    one_line(caught.value)
