"""Checkpoints of a training run: one safetensors file, written atomically, without pickle."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn
from torch.optim import Optimizer

from deepdetect._shared.errors import WeightsError, first_line
from deepdetect._shared.records import key

from ..networks.weights import save_tensors

Point = dict[str, float]
"""A point of the training curves: the number of steps, the losses and the measures, by name."""


def save_checkpoint(
    path: Path,
    network: nn.Module,
    average: nn.Module,
    optimizers: Sequence[Optimizer],
    metadata: Mapping[str, Any],
) -> None:
    """Write a checkpoint: the tensors of a run, and its metadata as JSON.

    Tensors are named "network.NAME", "average.NAME" and "optimizer.MOMENT.PARAMETER".
    """
    tensors = {f"network.{name}": value for name, value in network.state_dict().items()}
    tensors |= {f"average.{name}": value for name, value in average.state_dict().items()}
    for name, parameter in network.named_parameters():
        for optimizer in optimizers:
            for moment, value in optimizer.state.get(parameter, {}).items():
                tensors[f"optimizer.{moment}.{name}"] = value
    state = json.dumps(metadata)
    save_tensors(tensors, path, {"state": state, "digest": _digest(tensors, state)})


def read_checkpoint(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return a checkpoint's tensors and metadata; raise a WeightsError if it is damaged."""
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in list(file.keys())}
            header = file.metadata() or {}
        if header["digest"] != _digest(tensors, header["state"]):
            raise ValueError("its checksum is wrong")
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        raise WeightsError(
            f"the checkpoint {path} is damaged ({first_line(error)}): delete it to start again"
        ) from None
    return tensors, json.loads(header["state"])


def restore(
    tensors: Mapping[str, Tensor],
    network: nn.Module,
    average: nn.Module,
    optimizers: Sequence[Optimizer],
) -> None:
    """Restore a network, its moving average and its optimisers from a checkpoint of the same run.

    The caller must make sure that the run is the same: the shapes of the optimisers' moments are
    not checked, and a fused optimiser would write past the end of a moment that is too small.
    """
    for kind, module in (("network", network), ("average", average)):
        module.load_state_dict({name: tensors[f"{kind}.{name}"] for name in module.state_dict()})
    parameters = dict(network.named_parameters())
    owners = {
        parameter: optimizer
        for optimizer in optimizers
        for group in optimizer.param_groups
        for parameter in group["params"]
    }
    for name, value in tensors.items():
        if name.startswith("optimizer."):
            _, moment, of_parameter = name.split(".", 2)
            parameter = parameters[of_parameter]
            owners[parameter].state[parameter][moment] = _like(value, parameter)


def _like(value: Tensor, parameter: Tensor) -> Tensor:
    """Copy an optimiser moment to its parameter's device and memory layout, for fused Adam."""
    if value.shape == parameter.shape:
        return torch.empty_like(parameter).copy_(value)
    return value.to(parameter.device, copy=True)


def _digest(tensors: Mapping[str, Tensor], state: str) -> str:
    return key({name: value.detach().cpu().numpy() for name, value in tensors.items()}, state)
