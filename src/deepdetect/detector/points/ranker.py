"""The ranker: a small network that orders candidates by how surely they are found again."""

from __future__ import annotations

import functools
import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from ..._shared.errors import MissingWeightsError, WeightsError
from ..pretrained import RANKER
from .candidate_features import FEATURES

MAX_DEVIATIONS = 6.0
"""Features further from their mean are taken as this many standard deviations away."""

_LAYERS = ("weight0", "bias0", "weight1", "bias1", "weight2", "bias2")
_CHUNK = 65_536
_Item = TypeVar("_Item")


@dataclass(frozen=True, eq=False)
class Ranker:
    """Weights of the ranker: a logit is the first feature plus a perceptron of all of them.

    Attributes:
        mean, deviation: (F,) float32 of the features over the photographs it was trained on.
        layers: weights (outputs, inputs) and biases of three layers, with ReLU between them.
        notes: what is known about its training.
    """

    mean: np.ndarray
    deviation: np.ndarray
    layers: tuple[tuple[np.ndarray, np.ndarray], ...]
    notes: str = ""

    def rank(self, features: np.ndarray) -> np.ndarray:
        """Compute logits.

        Args:
            features: (N, F) float32.

        Returns:
            (N,) float32, the higher the better.
        """
        logits = np.empty(len(features), np.float32)
        for start in range(0, len(features), _CHUNK):
            part = features[start : start + _CHUNK]
            values = (part - self.mean) / self.deviation
            values = np.clip(values, -MAX_DEVIATIONS, MAX_DEVIATIONS)
            for k, (weight, bias) in enumerate(self.layers):
                values = values @ weight.T + bias
                if k + 1 < len(self.layers):
                    values = np.maximum(values, 0)
            logits[start : start + _CHUNK] = part[:, 0] + values[:, 0]
        return logits


def load_ranker(path: Path = RANKER) -> Ranker:
    """Load a ranker; the last few are kept.

    Args:
        path: an npz file, as `deepdetect train-points` writes it.

    Raises:
        WeightsError: the file is missing, damaged or of another network.
    """
    try:
        state = path.stat().st_mtime_ns
    except OSError:
        raise MissingWeightsError(f"there is no weights file {path}: check the path") from None
    return _load(path.absolute(), state)


@functools.lru_cache(maxsize=4)
def _load(path: Path, state: int) -> Ranker:
    """Read a file; one whose state has changed since is read again."""
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            found = {name: file[name] for name in ("mean", "deviation", *_LAYERS, "notes")}
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        reason = (str(error).splitlines() or ["it is empty"])[0]
        raise WeightsError(f"{path} does not hold weights of the ranker ({reason})") from None
    notes = str(found.pop("notes"))
    sides = [found[name].shape for name in _LAYERS]
    fits = (
        found["mean"].shape == found["deviation"].shape == (FEATURES,)
        and all(len(weight) == 2 and bias == weight[:1] for weight, bias in _pairs(sides))
        and [weight[1] for weight, _ in _pairs(sides)]
        == [FEATURES, *(weight[0] for weight, _ in _pairs(sides)[:-1])]
        and sides[-1] == (1,)
        and all(np.isfinite(value).all() for value in found.values())
    )
    if not fits:
        raise WeightsError(f"{path} holds another network than the ranker: use other weights")
    values = [found[name].astype(np.float32) for name in _LAYERS]
    mean, deviation = (found[name].astype(np.float32) for name in ("mean", "deviation"))
    return Ranker(mean, deviation, tuple(_pairs(values)), notes)


def _pairs(items: list[_Item]) -> list[tuple[_Item, _Item]]:
    """Return weights with their biases."""
    return list(zip(items[::2], items[1::2], strict=True))


def notes_of(ranker: Ranker) -> dict[str, object]:
    """Return what the file says about the training."""
    found: dict[str, object] = json.loads(ranker.notes) if ranker.notes else {}
    return found
