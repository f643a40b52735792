"""The network of the descriptor that published networks teach; it starts as EdgePoint2-L64 (MIT).

EdgePoint2 was trained on real pairs, with changes of season and light that synthetic views lack.
`EdgeNetwork` samples its feature maps at keypoints only: a descriptor for every fourth pixel, as in
EdgePoint2, would take more time than the maps. From the maps, it also predicts a score for each
candidate keypoint: how well it would survive a change of light or view.
"""

from __future__ import annotations

import pickle
from functools import reduce
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, interpolate, pad, relu
from torch.nn.utils.fusion import fuse_conv_bn_weights

from deepdetect._shared.errors import MissingWeightsError, WeightsError
from deepdetect.features.learned import LENGTH

from ..teachers.readings import CODE_LENGTHS
from .network import KeypointNetwork, double, read_map, shares_of_octaves, size_features

EDGE_CHANNELS = (8, 16, 48, 64)
"""Numbers of channels at 1/2, 1/4, 1/8 and 1/32 of the size of an octave, as in the published
weights of EdgePoint2-L64."""

CONTEXT_CHANNELS, GROUP = 64, 16
"""Channels of the map at 1/8 of an octave's size, and channels per group of its convolution. The
network would take 8 % more time without groups, and 6 % more with 96 channels."""

HIDDEN = 128
"""Hidden units of the perceptron. With 160, a descriptor would take 4 % more time."""

SCORE_CHANNELS = 8
"""Channels of the map of scores, at 1/4 of an octave's size. At 1/2, an image took 3 ms more."""

VARIANCE = 1e-5
"""Added to the variances in image and batch normalisation, as the published weights expect."""

BACKBONE = "at_half", "around_half", "block"
"""Name prefixes of the layers that start from EdgePoint2's weights."""

PUBLISHED = {
    "at_half": "block1.0.layer.0",
    "around_half": "block1.1.layer.0",
    "block_half.first": "block1.2.layer.0",
    "block_half.second": "block1.2.layer.3",
    "block_eighth.first": "block2.layer.0",
    "block_eighth.second": "block2.layer.3",
    "block_eighth.skip": "block2.skip",
    "block_coarsest.first": "block3.layer.0",
    "block_coarsest.second": "block3.layer.3",
    "block_coarsest.skip": "block3.skip",
}
"""Names of layers of `EdgeNetwork`, and of EdgePoint2's convolutions whose weights they start from.
In a sequence called `layer`, each of these convolutions precedes its batch normalisation."""


class Residual(nn.Module):
    """Two convolutions whose result is added to a linear map of the input."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(inputs, outputs, 3, padding=1)
        self.second = nn.Conv2d(outputs, outputs, 3, padding=1)
        self.skip = nn.Conv2d(inputs, outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        return relu(self.second(relu(self.first(x))) + self.skip(x))


class Halved(nn.Module):
    """A residual block whose result has half of the width and the height.

    EdgePoint2 computes the sum at every pixel, and takes the mean of each 2x2 pixels after ReLU.
    Here the mean is taken before ReLU, which saves a tenth of the network's time.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 4, 2, 1)

    def forward(self, x: Tensor) -> Tensor:
        return relu(self.second(relu(self.first(x))) + avg_pool2d(x, 2))


class EdgeNetwork(KeypointNetwork):
    """A network that describes and scores keypoints, and predicts the descriptors of its teachers.

    It takes luma images whose sides are multiples of 128. EdgePoint2's batch normalisation is
    folded into the convolutions.
    """

    octaves = 3
    strides = (4, 8)

    def __init__(self) -> None:
        super().__init__()
        half, quarter, eighth, coarsest = EDGE_CHANNELS
        context = CONTEXT_CHANNELS
        self.at_half = nn.Conv2d(1, half, 4, 2, 1)
        self.around_half = nn.Conv2d(half, quarter, 3, padding=1)
        self.block_half = Halved(quarter)
        self.block_eighth = Residual(quarter, eighth)
        self.block_coarsest = Residual(eighth, coarsest)
        self.to_eighth = nn.Conv2d(coarsest, context, 1, bias=False)
        self.own_eighth = nn.Conv2d(eighth, context, 1)
        groups = context // GROUP
        self.around_eighth = nn.Conv2d(context, context, 3, padding=1, groups=groups)
        self.add_perceptron(quarter + context, HIDDEN)
        self.score_quarter = nn.Conv2d(quarter, SCORE_CHANNELS, 1)
        self.score_eighth = nn.Conv2d(context, SCORE_CHANNELS, 1)
        self.score_output = nn.Conv2d(SCORE_CHANNELS, 2, 1)
        self.score_size = nn.Linear(3, 1)
        self.teach = nn.Linear(LENGTH, sum(CODE_LENGTHS))

    def maps(self, luma: Tensor) -> list[list[Tensor]]:
        """Return two feature maps of each octave, at 1/4 and 1/8 of its size.

        The map at 1/8 also contains context from a map at 1/32.
        """
        mean = luma.mean((2, 3), keepdim=True)
        variance = (luma - mean).square().mean((2, 3), keepdim=True)
        x, result = (luma - mean) * (variance + VARIANCE).rsqrt(), []
        for octave in range(self.octaves):
            if octave:
                x = avg_pool2d(x, 2)
            quarter = self.block_half(relu(self.around_half(relu(self.at_half(x)))))
            eighth = self.block_eighth(avg_pool2d(quarter, 2))
            coarse = self.to_eighth(self.block_coarsest(avg_pool2d(eighth, 4)))
            coarse = interpolate(coarse, scale_factor=4, mode="bilinear", align_corners=False)
            around = self.around_eighth(self.own_eighth(eighth) + coarse)
            result.append([quarter, relu(around)])
        return result

    def scores(self, maps: list[list[Tensor]], xy: Tensor, sizes: Tensor) -> Tensor:
        """Return scores (B, N), logits, of candidates at positions (B, N, 2) with sizes (B, N)."""
        parts: list[Tensor] = []
        for octave, (quarter, eighth) in enumerate(maps):
            coarse = double(self.score_eighth(eighth.float()))
            found = self.score_output(relu(self.score_quarter(quarter.float()) + coarse))
            parts.append(read_map(found, (xy + 0.5) / (4 << octave) - 0.5))
        shares = shares_of_octaves(sizes, self.octaves)
        own = map(torch.mul, (part[..., 1:] for part in parts), shares)
        fine, size = parts[0][..., :1], self.score_size(size_features(sizes))
        result: Tensor = (fine + reduce(torch.add, own) + size)[..., 0]
        return result

    def start_from(self, path: Path) -> None:
        """Load the weights of EdgePoint2-L64 from the authors' file `L64.pth`.

        Raises:
            WeightsError: the file is missing or holds another network.
        """
        if not path.is_file():
            raise MissingWeightsError(
                f"there is no {path}: take L64.pth from github.com/HITCSC/EdgePoint2"
            )
        try:
            stored = torch.load(path, "cpu", weights_only=True)
            for name, published in PUBLISHED.items():
                weight, bias = _folded(stored, published)
                own = self.get_submodule(name)
                if name == "block_half.second":  # the mean of 2x2 pixels, as one convolution
                    moved = [pad(weight, (j, 1 - j, i, 1 - i)) for i in (0, 1) for j in (0, 1)]
                    weight = torch.stack(moved).mean(0)
                own.load_state_dict({"weight": weight, "bias": bias})
        except (KeyError, RuntimeError, pickle.UnpicklingError):
            raise WeightsError(f"{path} does not hold the weights of EdgePoint2-L64") from None


def _folded(stored: dict[str, Tensor], name: str) -> tuple[Tensor, Tensor]:
    """Return a convolution's kernel and bias, with its batch normalisation, if any, folded in."""
    weight = stored[f"{name}.weight"]
    sequence, _, place = name.rpartition(".")
    if not place.isdigit():
        return weight, stored[f"{name}.bias"]
    norm = f"{sequence}.{int(place) + 1}"
    statistics = stored[f"{norm}.running_mean"], stored[f"{norm}.running_var"]
    scale = stored[f"{norm}.weight"], stored[f"{norm}.bias"]
    return fuse_conv_bn_weights(weight, None, *statistics, VARIANCE, *scale)
