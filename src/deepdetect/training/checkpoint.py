"""Checkpoints of a training run: one safetensors file, written whole; nothing is pickled."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import nn

from ..atomic import atomic_path
from ..errors import WeightsError

MOMENTS = ("step", "exp_avg", "exp_avg_sq")  # of Adam, for each parameter


def save_checkpoint(
    path: Path, network: nn.Module, optimizer: torch.optim.Adam, state: dict[str, Any]
) -> None:
    """Write the network, Adam's moments and the run's state.

    Args:
        path: the file.
        network: its state dict is stored under "network.".
        optimizer: its moments are stored under "adam.MOMENT.PARAMETER".
        state: anything JSON can hold.
    """
    tensors = {f"network.{name}": value for name, value in network.state_dict().items()}
    for name, parameter in network.named_parameters():
        for moment in MOMENTS:
            if parameter in optimizer.state:
                tensors[f"adam.{moment}.{name}"] = optimizer.state[parameter][moment]
    contiguous = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    with atomic_path(path) as temporary:
        save_file(contiguous, temporary, metadata={"state": json.dumps(state)})


@dataclass(frozen=True)
class Checkpoint:
    """What a checkpoint file holds.

    Attributes:
        state: the run's state.
        tensors: the network's and Adam's, by name.
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
    checkpoint: Checkpoint, path: Path, network: nn.Module, optimizer: torch.optim.Adam
) -> None:
    """Bring the network and Adam to a checkpoint's state.

    Raises:
        WeightsError: the checkpoint does not fit the network.
    """
    tensors = checkpoint.tensors
    prefix = "network."
    try:
        network.load_state_dict(
            {n.removeprefix(prefix): t for n, t in tensors.items() if n.startswith(prefix)}
        )
        for name, parameter in network.named_parameters():
            if f"adam.step.{name}" in tensors:
                optimizer.state[parameter] = {
                    "step": tensors[f"adam.step.{name}"].to(parameter.device, copy=True),
                    # Laid out in memory as the parameter is: fused Adam walks them in parallel.
                    **{
                        moment: torch.empty_like(parameter).copy_(tensors[f"adam.{moment}.{name}"])
                        for moment in MOMENTS[1:]
                    },
                }
    except (KeyError, ValueError, RuntimeError) as error:
        raise _unfit(path, error) from None


def _unfit(path: Path, error: Exception) -> WeightsError:
    reason = str(error).splitlines()[0]
    return WeightsError(
        f"{path} is not a checkpoint of this network ({reason}): "
        "delete it, or train into another folder"
    )
