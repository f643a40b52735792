"""Checkpoints of a training run: one safetensors file, written whole; nothing is pickled."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
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

MAX_INTEGER = 2**53
"""Larger ones may have no equal among the floats that they are divided by."""


@dataclass
class TrainingState:
    """How far a run has come.

    Attributes:
        step: optimiser steps done.
        loss_sum, loss_count: of the training batches since the last point of the curves.
        points: the curves.
    """

    step: int = 0
    loss_sum: float = 0.0
    loss_count: int = 0
    points: list[Point] = field(default_factory=list)

    @classmethod
    def from_json(
        cls, values: Mapping[str, Any], last_step: int, columns: Sequence[str]
    ) -> TrainingState:
        """Read the state from a checkpoint's metadata.

        Args:
            values: the metadata.
            last_step: of the run.
            columns: names of the values of a point.

        Raises:
            ValueError: a value is missing, of another type or out of its range.
        """
        step, count = (_number(values.get(name), name, int) for name in ("step", "loss_count"))
        if step > last_step:
            raise ValueError(f"step {step} lies behind the last one, {last_step}")
        rows = values.get("points")
        if not isinstance(rows, list):
            raise ValueError("points is not a list")
        points = [read_point(row, columns) for row in rows]
        if any(a >= b for a, b in pairwise([*(point["step"] for point in points), step + 1])):
            raise ValueError("points are not in the order of their steps")
        if (count == 0) != (step == (points[-1]["step"] if points else 0)):
            raise ValueError("loss_count does not fit the last point")
        return cls(step, _number(values.get("loss_sum"), "loss_sum", float), count, points)


def read_point(row: Any, columns: Sequence[str]) -> Point:
    """Read a point of the curves from JSON.

    Raises:
        ValueError: a value is missing or not finite.
    """
    if not isinstance(row, dict) or row.keys() != set(columns):
        raise ValueError("a point has other columns")
    return {name: _number(row[name], name, type(row[name])) for name in columns}


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint file: its path, its metadata, and the tensors of network and optimisers."""

    path: Path
    metadata: dict[str, Any]
    tensors: dict[str, Tensor]

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
    """Write the network ("network.NAME"), its optimisers ("optimizer.MOMENT.PARAMETER") and JSON.

    Raises:
        DeepDetectError: the file cannot be written.
    """
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
    """Read a checkpoint file.

    Raises:
        WeightsError: the file is damaged.
    """
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in list(file.keys())}
            metadata = json.loads((file.metadata() or {})["state"])
    except (SafetensorError, OSError, KeyError, ValueError, RecursionError) as error:
        raise Checkpoint(path, {}, {}).unfit(error) from None
    if not isinstance(metadata, dict):
        raise Checkpoint(path, {}, {}).unfit("its state is not an object")
    return Checkpoint(path, metadata, tensors)


def restore(checkpoint: Checkpoint, network: nn.Module, optimizers: Sequence[Optimizer]) -> None:
    """Bring the network and its optimisers to a checkpoint's state.

    All tensors are checked first: fused optimisers write beyond a moment of another shape.

    Raises:
        WeightsError: the checkpoint does not fit the network; nothing was changed.
    """
    names = {parameter: name for name, parameter in network.named_parameters()}
    trained = [
        (optimizer, parameter, state_shapes(optimizer, parameter))
        for optimizer in optimizers
        for group in optimizer.param_groups
        for parameter in group["params"]
    ]
    wanted = {f"network.{n}": (v.dtype, tuple(v.shape)) for n, v in network.state_dict().items()}
    for _, parameter, shapes in trained:
        for moment, shape in shapes.items():
            wanted[f"optimizer.{moment}.{names[parameter]}"] = torch.float32, shape
    tensors = checkpoint.tensors
    found = {name: (value.dtype, tuple(value.shape)) for name, value in tensors.items()}
    for name in sorted(wanted.keys() | found.keys()):
        if wanted.get(name) != found.get(name):
            is_now, should = (each.get(name, "missing") for each in (found, wanted))
            raise checkpoint.unfit(f"{name} is {is_now}, it should be {should}")
        if not tensors[name].isfinite().all():
            raise checkpoint.unfit(f"{name} is not finite")
        if (
            name.startswith(("optimizer.step.", "optimizer.exp_avg_sq."))
            and tensors[name].min() < 0
        ):
            raise checkpoint.unfit(f"{name} is negative")
    network.load_state_dict({name: tensors[f"network.{name}"] for name in network.state_dict()})
    for optimizer, parameter, shapes in trained:
        optimizer.state[parameter] = {
            moment: _like(tensors[f"optimizer.{moment}.{names[parameter]}"], parameter)
            for moment in shapes
        }


def _like(value: Tensor, parameter: Tensor) -> Tensor:
    """Bring a moment to its parameter's device and memory layout, which fused Adam relies on."""
    if value.shape == parameter.shape:
        return torch.empty_like(parameter).copy_(value)
    return value.to(parameter.device, copy=True)


def _number(value: Any, name: str, kind: type) -> Any:
    """Return a finite number, not negative if it is an integer; else raise a ValueError."""
    whole = type(value) is int and abs(value) <= MAX_INTEGER
    if kind is int and whole and value >= 0:
        return value
    if kind is float and (whole or (type(value) is float and math.isfinite(value))):
        return float(value)
    raise ValueError(f"{name} is not a number that it can be")
