"""Checkpoints of a training run: one safetensors file, written whole; nothing is pickled."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import nn
from torch.optim import Optimizer

from .._shared.atomic import atomic_path
from .._shared.errors import WeightsError


def save_checkpoint(
    path: Path, network: nn.Module, optimizers: Sequence[Optimizer], state: dict[str, Any]
) -> None:
    """Write the network, the optimisers' moments and the run's state.

    Args:
        path: the file.
        network: its state dict is stored under "network.".
        optimizers: of its parameters; what they hold is stored under
            "optimizer.MOMENT.PARAMETER".
        state: anything JSON can hold.
    """
    tensors = {f"network.{name}": value for name, value in network.state_dict().items()}
    for name, parameter in network.named_parameters():
        for optimizer in optimizers:
            for moment, value in optimizer.state.get(parameter, {}).items():
                tensors[f"optimizer.{moment}.{name}"] = value
    contiguous = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    with atomic_path(path) as temporary:
        save_file(contiguous, temporary, metadata={"state": json.dumps(state)})


@dataclass(frozen=True)
class Checkpoint:
    """What a checkpoint file holds.

    Attributes:
        state: the run's state.
        tensors: the network's and the optimisers', by name.
    """

    state: dict[str, Any]
    tensors: dict[str, torch.Tensor]


def read_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint's file.

    Raises:
        WeightsError: the file is damaged.
    """
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in list(file.keys())}
            state = json.loads((file.metadata() or {})["state"])
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        raise _unfit(path, error) from None
    return Checkpoint(state, tensors)


def restore(
    checkpoint: Checkpoint, path: Path, network: nn.Module, optimizers: Sequence[Optimizer]
) -> None:
    """Bring the network and its optimisers to a checkpoint's state.

    Raises:
        WeightsError: the checkpoint does not fit the network.
    """
    tensors = checkpoint.tensors
    prefix = "network."
    try:
        network.load_state_dict(
            {n.removeprefix(prefix): t for n, t in tensors.items() if n.startswith(prefix)}
        )
        moments = _moments(tensors)
        names = {parameter: name for name, parameter in network.named_parameters()}
        for optimizer in optimizers:
            for group in optimizer.param_groups:
                for parameter in group["params"]:
                    held = moments[names[parameter]]
                    optimizer.state[parameter] = {
                        moment: _placed(value, parameter) for moment, value in held.items()
                    }
    except (KeyError, ValueError, RuntimeError) as error:
        raise _unfit(path, error) from None


def _moments(tensors: dict[str, torch.Tensor]) -> dict[str, dict[str, torch.Tensor]]:
    """Return what the optimisers hold, by parameter and moment."""
    found: dict[str, dict[str, torch.Tensor]] = {}
    for key, value in tensors.items():
        kind, _, rest = key.partition(".")
        if kind == "optimizer":
            moment, _, name = rest.partition(".")
            found.setdefault(name, {})[moment] = value
    return found


def _placed(value: torch.Tensor, parameter: nn.Parameter) -> torch.Tensor:
    """Bring a moment to its parameter's device.

    Laid out in memory as the parameter is: fused Adam walks them in parallel.
    """
    if value.shape == parameter.shape:
        return torch.empty_like(parameter).copy_(value)
    return value.to(parameter.device, copy=True)


def _unfit(path: Path, error: Exception) -> WeightsError:
    reason = str(error).splitlines()[0]
    return WeightsError(
        f"{path} is not a checkpoint of this network ({reason}): "
        "delete it, or train into another folder"
    )
