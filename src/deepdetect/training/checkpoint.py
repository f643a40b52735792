"""Checkpoints of a training run: one safetensors file, written whole; nothing is pickled."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.optim import Optimizer

from .._shared.atomic import atomic_path
from .._shared.errors import WeightsError
from .optim import state_shapes

Point = dict[str, float]
"""A point of the curves: losses and measures by name after a number of steps."""

LARGEST = sys.float_info.max
"""Larger integers, which JSON may hold, have no equal among the floats."""

NEVER_NEGATIVE = ("optimizer.step.", "optimizer.exp_avg_sq.")


@dataclass
class TrainingState:
    """The steps done, the curves, and the losses of the batches since their last point."""

    step: int = 0
    loss_sum: float = 0.0
    loss_count: int = 0
    points: list[Point] = field(default_factory=list)


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint file: its path, its metadata, and the tensors of network and optimisers."""

    path: Path
    metadata: dict[str, Any]
    tensors: dict[str, Tensor]

    def state(self, last_step: int, columns: Sequence[str]) -> TrainingState:
        """Return how far the run has come; a WeightsError where its values cannot be so."""
        values: dict[str, Any] = {n.name: self.metadata.get(n.name) for n in fields(TrainingState)}
        state = TrainingState(**values)
        points = state.points
        if not isinstance(points, list) or any(
            not isinstance(point, dict) or point.keys() != {*columns} for point in points
        ):
            raise self.unfit("the points of its curves have other columns")
        numbers = [state.loss_sum, *(value for point in points for value in point.values())]
        counts = [state.step, state.loss_count]
        if not all(isinstance(n, (int, float)) and abs(n) <= LARGEST for n in numbers) or not all(
            isinstance(n, int) and 0 <= n <= last_step for n in counts
        ):
            raise self.unfit("step, loss or points are not numbers that they can be")
        return state

    def restore(self, network: nn.Module, optimizers: Sequence[Optimizer]) -> None:
        """Bring the network and its optimisers to the state of the checkpoint.

        All tensors are checked first (a WeightsError): fused optimisers write beyond a moment of
        another shape.
        """
        names = {parameter: name for name, parameter in network.named_parameters()}
        trained = [
            (optimizer, parameter, state_shapes(optimizer, parameter))
            for optimizer in optimizers
            for group in optimizer.param_groups
            for parameter in group["params"]
        ]
        wanted = {
            f"network.{n}": (v.dtype, tuple(v.shape)) for n, v in network.state_dict().items()
        }
        for _, parameter, shapes in trained:
            for moment, shape in shapes.items():
                wanted[f"optimizer.{moment}.{names[parameter]}"] = torch.float32, shape
        found = {name: (value.dtype, tuple(value.shape)) for name, value in self.tensors.items()}
        for name in sorted(wanted.keys() | found.keys()):
            if wanted.get(name) != found.get(name):
                is_now, should = (each.get(name, "missing") for each in (found, wanted))
                raise self.unfit(f"{name} is {is_now}, it should be {should}")
            value = self.tensors[name]
            if not value.isfinite().all() or (name.startswith(NEVER_NEGATIVE) and value.min() < 0):
                raise self.unfit(f"{name} has values that it cannot have")
        network.load_state_dict({n: self.tensors[f"network.{n}"] for n in network.state_dict()})
        for optimizer, parameter, shapes in trained:
            optimizer.state[parameter] = {
                moment: _like(self.tensors[f"optimizer.{moment}.{names[parameter]}"], parameter)
                for moment in shapes
            }

    def unfit(self, reason: object) -> WeightsError:
        """Return the error for a checkpoint that cannot be resumed from."""
        text = str(reason).splitlines()[0] if str(reason) else type(reason).__name__
        return WeightsError(
            f"{self.path} is not a checkpoint of this network ({text}): "
            "delete it, or train into another folder"
        )


def save_checkpoint(
    path: Path, network: nn.Module, optimizers: Sequence[Optimizer], metadata: Mapping[str, Any]
) -> None:
    """Write "network.NAME" of the network, "optimizer.MOMENT.PARAMETER" of its optimisers, JSON."""
    tensors = {f"network.{name}": value for name, value in network.state_dict().items()}
    for name, parameter in network.named_parameters():
        for optimizer in optimizers:
            for moment, value in optimizer.state.get(parameter, {}).items():
                tensors[f"optimizer.{moment}.{name}"] = value
    contiguous = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    with atomic_path(path) as temporary:
        try:
            save_file(contiguous, temporary, metadata={"state": json.dumps(metadata)})
        except SafetensorError as error:  # a full disk
            raise OSError(str(error)) from None


def read_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint file; a WeightsError where it is damaged."""
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in list(file.keys())}
            metadata = dict(json.loads((file.metadata() or {})["state"]))
    except (SafetensorError, OSError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise Checkpoint(path, {}, {}).unfit(error) from None
    return Checkpoint(path, metadata, tensors)


def _like(value: Tensor, parameter: Tensor) -> Tensor:
    """Bring a moment to its parameter's device and memory layout, which fused Adam relies on."""
    if value.shape == parameter.shape:
        return torch.empty_like(parameter).copy_(value)
    return value.to(parameter.device, copy=True)
