"""Checkpoints of a training run: one safetensors file, written whole; nothing is pickled."""

from __future__ import annotations

import json
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


def load_checkpoint(path: Path, network: nn.Module, optimizer: torch.optim.Adam) -> dict[str, Any]:
    """Read a checkpoint into the network and the optimiser.

    Returns:
        The run's state.

    Raises:
        WeightsError: the file is damaged or does not fit the network.
    """
    try:
        with safe_open(path, framework="pt") as file:
            names = list(file.keys())
            tensors = {name: file.get_tensor(name) for name in names}
            state = json.loads((file.metadata() or {})["state"])
        prefix = "network."
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
    except (SafetensorError, OSError, KeyError, ValueError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise WeightsError(
            f"{path} is not a checkpoint of this network ({reason}): "
            "delete it, or train into another folder"
        ) from None
    return state
