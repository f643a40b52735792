"""The ranker as a torch module, and as the file that it is run from."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ..._shared.atomic import atomic_path
from ...detector.points.ranker import MAX_DEVIATIONS, Ranker

HIDDEN_UNITS = (48, 32)
MIN_DEVIATION = 1e-3
INITIAL_OUTPUT = 0.01
"""The last layer starts at almost nothing: an untrained ranker ranks as |det Hessian| does."""


class RankerModule(nn.Module):
    """A perceptron of the features, added to the first of them; made from their statistics (F,)."""

    mean: Tensor
    deviation: Tensor

    def __init__(self, mean: np.ndarray, deviation: np.ndarray) -> None:
        super().__init__()
        self.register_buffer("mean", torch.from_numpy(mean.astype(np.float32)))
        spread = np.maximum(deviation, MIN_DEVIATION).astype(np.float32)
        self.register_buffer("deviation", torch.from_numpy(spread))
        first, second = HIDDEN_UNITS
        self.first = nn.Linear(len(mean), first)
        self.second = nn.Linear(first, second)
        self.output = nn.Linear(second, 1)
        with torch.no_grad():
            self.output.weight.mul_(INITIAL_OUTPUT)
            self.output.bias.zero_()

    def forward(self, features: Tensor) -> Tensor:
        """Map (N, F) features to (N,) logits."""
        values = (features - self.mean) / self.deviation
        values = values.clamp(-MAX_DEVIATIONS, MAX_DEVIATIONS)
        values = self.second(self.first(values).relu()).relu()
        logits: Tensor = features[:, 0] + self.output(values)[:, 0]
        return logits

    def export(self, notes: dict[str, Any]) -> Ranker:
        """Return the same ranker without torch."""
        layers = tuple(
            (layer.weight.detach().numpy().copy(), layer.bias.detach().numpy().copy())
            for layer in (self.first, self.second, self.output)
        )
        text = json.dumps(notes, default=str, sort_keys=True)
        return Ranker(self.mean.numpy().copy(), self.deviation.numpy().copy(), layers, text)


def save_ranker(ranker: Ranker, path: Path) -> None:
    """Write a ranker as `load_ranker` reads it: the same bytes for the same ranker."""
    arrays = {"mean": ranker.mean, "deviation": ranker.deviation}
    for k, (weight, bias) in enumerate(ranker.layers):
        arrays |= {f"weight{k}": weight, f"bias{k}": bias}
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, notes=np.array(ranker.notes), **arrays)
