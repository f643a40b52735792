"""The network of a descriptor that is taught by published ones: it also scores and turns points.

It is a narrow `DescriptorNetwork`. From the same feature maps, it says how well a candidate at a
point would survive a change of light or view, and at which angle the point is described.
"""

from __future__ import annotations

from functools import reduce

import torch
from torch import Tensor, nn
from torch.nn.functional import relu

from ..teachers.readings import CODE_LENGTHS
from .network import DescriptorNetwork, Widths, double, read_map, shares_of_octaves, size_features

NARROW = Widths(16, 16, 32, 64, 128, hidden=128, length=128, every_map=False)
"""Maps and 2,048 descriptors at 640x480 take 21 ms of one thread in ONNX Runtime, 45 ms with the
widths of `Widths()`: measured before any training. 96 channels at 1/16 would take 3 ms more."""

SCORE_CHANNELS = 8
"""Channels from which scores are computed at 1/4 of the size. At 1/2, they would take 3 ms more."""


class TaughtNetwork(DescriptorNetwork):
    """A descriptor network with scores, angles, and a head that predicts the teachers' codes."""

    def __init__(self, widths: Widths = NARROW) -> None:
        super().__init__(widths)
        self.score_quarter = nn.Conv2d(widths.quarter, SCORE_CHANNELS, 1)
        self.score_eighth = nn.Conv2d(widths.eighth, SCORE_CHANNELS, 1)
        self.score_output = nn.Conv2d(SCORE_CHANNELS, 2, 1)
        self.score_size = nn.Linear(3, 1)
        self.angle = nn.Linear(widths.hidden, 2)
        self.teach = nn.Linear(widths.length, sum(CODE_LENGTHS))

    def forward(  # type: ignore[override]
        self, luma: Tensor, xy: Tensor, sizes: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return descriptors (B, N, 128), scores (B, N), and directions (B, N, 2) of the angles."""
        maps = self.maps(luma)
        features = self.features(maps, xy, sizes)
        directions = self.angle(features).unflatten(0, xy.shape[:2])
        return self.code(features, xy), self.scores(maps, xy, sizes), directions

    def scores(self, maps: list[list[Tensor]], xy: Tensor, sizes: Tensor) -> Tensor:
        """Return scores (B, N), logits: the higher, the better a candidate survives changes."""
        parts: list[Tensor] = []
        for octave, (_, quarter, eighth) in enumerate(maps):
            coarse = double(self.score_eighth(eighth.float()))
            found = self.score_output(relu(self.score_quarter(quarter.float()) + coarse))
            parts.append(read_map(found, (xy + 0.5) / (4 << octave) - 0.5))
        own = map(torch.mul, (part[..., 1:] for part in parts), shares_of_octaves(sizes))
        fine, size = parts[0][..., :1], self.score_size(size_features(sizes))
        result: Tensor = (fine + reduce(torch.add, own) + size)[..., 0]
        return result
