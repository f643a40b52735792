"""The network that matches keypoints by attention, and its ONNX file.

The layers are those of LightGlue with one head (Lindenberger et al., "LightGlue: Local Feature
Matching at Light Speed", 2023). `lab/HISTORY.md` tells from which weights the training started.
"""

from __future__ import annotations

from pathlib import Path

import onnx
import torch
from torch import Tensor, nn
from torch.nn.functional import gelu, log_softmax, logsigmoid, softmax

from deepdetect._shared.atomic import atomic_path
from deepdetect.features.learned import LENGTH

from ...networks.export import to_onnx
from ..descriptor.export import halve_weights

WIDTH, LAYERS = 96, 3
"""Numbers per keypoint, and layers: those of the weights with which the training started. Matching
2,048 by 2,048 keypoints takes about half a second on one processor."""

TRAITS = 4
"""Number of further traits of a keypoint."""


OUTPUTS = "partners", "probabilities", "back"
"""Outputs of the ONNX file: the likeliest partner of each keypoint of the first image and its
probability, and the likeliest partner of each keypoint of the second image."""


class Mixer(nn.Module):
    """Adds to each keypoint what it gathered by attention."""

    def __init__(self) -> None:
        super().__init__()
        self.gathered = nn.Linear(WIDTH, WIDTH)
        self.first, self.norm = nn.Linear(2 * WIDTH, 2 * WIDTH), nn.LayerNorm(2 * WIDTH)
        self.second = nn.Linear(2 * WIDTH, WIDTH)

    def forward(self, x: Tensor, gathered: Tensor) -> Tensor:
        both = torch.cat([x, self.gathered(gathered)], -1)
        change: Tensor = self.second(gelu(self.norm(self.first(both))))
        return x + change


class Layer(nn.Module):
    """Attention to the keypoints of the own image, and then to those of the other image."""

    def __init__(self) -> None:
        super().__init__()
        self.query, self.key, self.value = (nn.Linear(WIDTH, WIDTH) for _ in range(3))
        self.within = Mixer()
        self.compared, self.shown = nn.Linear(WIDTH, WIDTH), nn.Linear(WIDTH, WIDTH)
        self.across = Mixer()

    def forward(
        self, x0: Tensor, x1: Tensor, place0: tuple[Tensor, Tensor], place1: tuple[Tensor, Tensor]
    ) -> tuple[Tensor, Tensor]:
        x0, x1 = self._within(x0, *place0), self._within(x1, *place1)
        alike = self.compared(x0) @ self.compared(x1).T * WIDTH**-0.5
        gathered0 = softmax(alike, 1) @ self.shown(x1)
        gathered1 = softmax(alike.T, 1) @ self.shown(x0)
        return self.across(x0, gathered0), self.across(x1, gathered1)

    def _within(self, x: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
        query, key = (turned(each(x), cosine, sine) for each in (self.query, self.key))
        weights = softmax(query @ key.T * WIDTH**-0.5, 1)
        mixed: Tensor = self.within(x, weights @ self.value(x))
        return mixed


class Matcher(nn.Module):
    """A network that returns, for all pairs of keypoints, the logarithm of the match probability.

    Its inputs are those of `attention_inputs`.
    """

    def __init__(self) -> None:
        super().__init__()
        self.descriptor = nn.Linear(LENGTH, WIDTH)
        wide = 2 * WIDTH
        self.adapted = nn.Sequential(nn.Linear(LENGTH, wide), nn.GELU(), nn.Linear(wide, WIDTH))
        self.traits = nn.Linear(TRAITS, WIDTH, bias=False)
        self.place = nn.Linear(2, WIDTH // 2, bias=False)
        self.layers = nn.ModuleList(Layer() for _ in range(LAYERS))
        self.final, self.matchable = nn.Linear(WIDTH, WIDTH), nn.Linear(WIDTH, 1)
        nn.init.zeros_(self.traits.weight)

    def forward(
        self,
        xy0: Tensor,
        descriptors0: Tensor,
        traits0: Tensor,
        xy1: Tensor,
        descriptors1: Tensor,
        traits1: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return (N, M) log probabilities, and logits (N,) and (M,) of having any partner."""
        x0, x1 = self._started(descriptors0, traits0), self._started(descriptors1, traits1)
        place0, place1 = self._placed(xy0), self._placed(xy1)
        for layer in self.layers:
            x0, x1 = layer(x0, x1, place0, place1)
        alike = self.final(x0) @ self.final(x1).T * WIDTH**-0.5
        any0, any1 = self.matchable(x0)[:, 0], self.matchable(x1)[:, 0]
        chances = logsigmoid(any0)[:, None] + logsigmoid(any1)[None, :]
        return log_softmax(alike, 1) + log_softmax(alike, 0) + chances, any0, any1

    def _started(self, descriptors: Tensor, traits: Tensor) -> Tensor:
        read: Tensor = self.descriptor(descriptors) + self.adapted(descriptors)
        return read + self.traits(traits)

    def _placed(self, xy: Tensor) -> tuple[Tensor, Tensor]:
        angles = self.place(xy)
        return angles.cos(), angles.sin()


class _Partners(nn.Module):
    """The matcher as it is written to ONNX: it returns the likeliest partner of each keypoint."""

    def __init__(self, network: Matcher) -> None:
        super().__init__()
        self.network = network

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        scores = self.network(*inputs)[0]
        best, partners = scores.max(1)
        return partners, best.exp(), scores.argmax(0)


def turned(x: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
    """Rotate each pair of numbers of (N, WIDTH) by an angle, so that products show offsets."""
    first, second = x[:, ::2], x[:, 1::2]
    pairs = torch.stack([first * cosine - second * sine, second * cosine + first * sine], -1)
    return pairs.flatten(1)


def export_matcher(network: Matcher, path: Path) -> None:
    """Write the network as an ONNX file, whose inputs are those of `attention_inputs`."""
    inputs, axes = {}, {"partners": {0: "first"}, "probabilities": {0: "first"}}
    for side, count, axis in (("0", 5, "first"), ("1", 7, "second")):
        for name, width in (("xy", 2), ("descriptors", LENGTH), ("traits", TRAITS)):
            inputs[name + side], axes[name + side] = torch.rand(count, width), {0: axis}
    axes["back"] = {0: "second"}
    model = to_onnx(_Partners(network), inputs, OUTPUTS, axes)
    halve_weights(model)
    with atomic_path(path) as temporary:
        onnx.save(model, temporary)
