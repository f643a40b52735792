"""The ranker: a small network that orders candidates by their chance to recur in another image."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..._shared.errors import MissingWeightsError, WeightsError, first_line
from ..pretrained import RANKER
from .candidate_features import FEATURES

MAX_DEVIATIONS, CHUNK = 6.0, 2048
"""Features are clipped at MAX_DEVIATIONS standard deviations from their mean. CHUNK candidates are
ranked at a time, so that their features stay in the processor's cache. Chosen by hand."""

LOGIT_AS_SIFT = 7.75
"""Keypoints with at least this logit are about as many as those of `cv2.SIFT_create()`: as many in
the geometric mean over photographs of photos/val, with a standard deviation of a factor of 1.6."""


@dataclass(frozen=True, eq=False)
class Ranker:
    """Weights of the ranker, a multilayer perceptron on the features of candidates.

    The logit of a candidate is its first feature plus the output of the perceptron, whose input is
    normalised by the (F,) `mean` and `deviation` of the features. Each of the `layers` has weights
    (outputs, inputs) and biases (outputs,), with ReLU between the layers.
    """

    mean: np.ndarray
    deviation: np.ndarray
    layers: tuple[tuple[np.ndarray, np.ndarray], ...]
    notes: str = ""

    def rank(self, features: np.ndarray) -> np.ndarray:
        """Compute the (N,) float32 logits of (N, F) float32 features; higher is better."""
        logits = np.empty(len(features), np.float32)
        for start in range(0, len(features), CHUNK):
            part = features[start : start + CHUNK]
            values = part - self.mean
            values /= self.deviation
            np.clip(values, -MAX_DEVIATIONS, MAX_DEVIATIONS, out=values)
            for k, (weight, bias) in enumerate(self.layers):
                values = values @ weight.T
                values += bias
                if k + 1 < len(self.layers):
                    np.maximum(values, 0, out=values)
            logits[start : start + CHUNK] = part[:, 0] + values[:, 0]
        return logits


def load_ranker(path: Path = RANKER) -> Ranker:
    """Load a ranker from an npz file that `deepdetect dev train-points` has written."""
    if not path.is_file():
        raise MissingWeightsError(f"there is no weights file {path}: check the path")
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            notes = str(file["notes"])
            mean, deviation = (file[name].astype(np.float32) for name in ("mean", "deviation"))
            layers = tuple(
                (file[f"weight{k}"].astype(np.float32), file[f"bias{k}"].astype(np.float32))
                for k in range(3)
            )
    except Exception as error:  # NumPy's readers raise many types of exceptions
        raise WeightsError(
            f"{path} does not hold weights of the ranker ({first_line(error)})"
        ) from None
    inputs = (FEATURES, *(len(bias) for _, bias in layers[:-1]))
    fits = (
        mean.shape == deviation.shape == (FEATURES,)
        and all(w.shape == (*b.shape, count) for (w, b), count in zip(layers, inputs, strict=True))
        and layers[-1][1].shape == (1,)
        and all(np.isfinite(each).all() for each in (mean, deviation, *itertools.chain(*layers)))
    )
    if not fits:
        raise WeightsError(
            f"{path} holds weights of a network other than the ranker: use other weights"
        )
    return Ranker(mean, deviation, layers, notes)
