"""The network of the learned descriptor: feature maps of the whole image, sampled at keypoints.

`DescriptorNetwork.maps` computes feature maps at 1/4 and 1/8 of the image size, with the same
kernels for three octaves: the image, and the image reduced to 1/2 and 1/4. `features` samples the
maps of the first octave and of the octave that fits the keypoint's size. A perceptron maps the
samples to 64 numbers: 16 that do not change when the image is rotated, and 48 that rotate with the
image (`deepdetect.features.learned`).

The network can start with layers of EdgePoint2-L64 (MIT), which was trained on real pairs, with
changes of season and light that synthetic views lack. It samples its feature maps at keypoints
only: a descriptor for every fourth pixel, as in EdgePoint2, would take more time than the maps.
"""

from __future__ import annotations

import math
import pickle
from functools import reduce
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, interpolate, normalize, pad, relu
from torch.nn.utils.fusion import fuse_conv_bn_weights

from deepdetect._shared.errors import MissingWeightsError, WeightsError
from deepdetect.features.learned import CONSTANT, FREQUENCIES, LENGTH

from ..teachers.readings import CODE_LENGTHS

OCTAVES = 3
STRIDES = (4, 8)
"""Pixels of an octave per pixel of each of its two maps."""

FIRST_OCTAVE_PX = 4.5
"""A keypoint up to this diameter is described by maps of the full image only. For a larger one,
maps of the two octaves nearest to its size are interpolated and used as well. Chosen by hand."""

SMALLEST_SIZE_PX = 2.5
"""Keypoints with a smaller diameter are described as if they had this one. Chosen by hand."""

CHANNELS = (8, 16, 48, 64)
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
"""Names of layers of `DescriptorNetwork`, and of EdgePoint2's convolutions whose weights they start
from. In a sequence called `layer`, each of these convolutions precedes its batch normalisation."""


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


class DescriptorNetwork(nn.Module):
    """A network that describes and scores keypoints, and predicts the descriptors of its teachers.

    It takes luma images whose sides are multiples of 128. A score tells how well a candidate
    keypoint would survive a change of light or view. EdgePoint2's batch normalisation is folded
    into the convolutions.
    """

    def __init__(self) -> None:
        super().__init__()
        half, quarter, eighth, coarsest = CHANNELS
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
        self.input = nn.Linear(2 * (quarter + context), HIDDEN)
        self.by_size = nn.Sequential(nn.Linear(3, 32), nn.ReLU(), nn.Linear(32, 2 * HIDDEN))
        nn.init.zeros_(self.get_parameter("by_size.2.weight"))
        nn.init.zeros_(self.get_parameter("by_size.2.bias"))
        self.norm, self.middle_norm = nn.BatchNorm1d(HIDDEN), nn.BatchNorm1d(HIDDEN)
        self.middle, self.output = nn.Linear(HIDDEN, HIDDEN), nn.Linear(HIDDEN, LENGTH)
        self.temperature = nn.Parameter(torch.tensor(math.log(20.0)))  # log of 1 / temperature
        self.score_quarter = nn.Conv2d(quarter, SCORE_CHANNELS, 1)
        self.score_eighth = nn.Conv2d(context, SCORE_CHANNELS, 1)
        self.score_output = nn.Conv2d(SCORE_CHANNELS, 2, 1)
        self.score_size = nn.Linear(3, 1)
        self.teach = nn.Linear(LENGTH, sum(CODE_LENGTHS))

    def forward(self, luma: Tensor, xy: Tensor, sizes: Tensor) -> Tensor:
        """Return (B, N, 64) descriptors of length 1 from luma (B, 1, H, W) in [0, 1].

        Positions (B, N, 2) and sizes (B, N) of the keypoints are in pixels.
        """
        return self.code(self.features(self.maps(luma), xy, sizes), xy)

    def code(self, features: Tensor, xy: Tensor) -> Tensor:
        """Return (B, N, 64) descriptors from hidden units (B * N, H) at keypoints (B, N, 2)."""
        return normalize(self.output(features), dim=1).unflatten(0, xy.shape[:2])

    def features(self, maps: list[list[Tensor]], xy: Tensor, sizes: Tensor) -> Tensor:
        """Return (B * N, H) hidden units at keypoints, from which `code` makes descriptors."""
        octaves = [
            torch.cat(
                [
                    read_map(features, (xy + 0.5) / (stride << octave) - 0.5)
                    for features, stride in zip(maps[octave], STRIDES, strict=True)
                ],
                2,
            )
            for octave in range(OCTAVES)
        ]
        own_octave = reduce(torch.add, map(torch.mul, octaves, shares_of_octaves(sizes)))
        features = self.input(torch.cat([octaves[0], own_octave], 2)).flatten(0, 1)
        seen = size_features(sizes).flatten(0, 1)
        gain, shift = self.by_size(seen).chunk(2, 1)
        features = relu(self.norm(features) * (1 + gain) + shift)
        return relu(self.middle_norm(self.middle(features)))

    def maps(self, luma: Tensor) -> list[list[Tensor]]:
        """Return two feature maps of each octave, at 1/4 and 1/8 of its size.

        The map at 1/8 also contains context from a map at 1/32.
        """
        mean = luma.mean((2, 3), keepdim=True)
        variance = (luma - mean).square().mean((2, 3), keepdim=True)
        x, result = (luma - mean) * (variance + VARIANCE).rsqrt(), []
        for octave in range(OCTAVES):
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
            coarse = self.score_eighth(eighth.float())
            coarse = interpolate(coarse, scale_factor=2, mode="bilinear", align_corners=False)
            found = self.score_output(relu(self.score_quarter(quarter.float()) + coarse))
            parts.append(read_map(found, (xy + 0.5) / (STRIDES[0] << octave) - 0.5))
        shares = shares_of_octaves(sizes)
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


def shares_of_octaves(sizes: Tensor) -> tuple[Tensor, ...]:
    """Return, for each octave, its interpolation weights (B, N, 1) for diameters (B, N)."""
    sizes = sizes.clamp(min=SMALLEST_SIZE_PX)
    own = (sizes / FIRST_OCTAVE_PX).log2().clamp(0, OCTAVES - 1)[..., None]
    shares = (1 - (own - torch.arange(OCTAVES, device=sizes.device)).abs()).clamp(min=0)
    return shares.split(1, -1)


def size_features(sizes: Tensor) -> Tensor:
    """Return three features (B, N, 3) of the logarithms of keypoint diameters (B, N) in pixels."""
    scale = (sizes.clamp(min=SMALLEST_SIZE_PX) / SMALLEST_SIZE_PX).log()[..., None]
    return torch.cat([scale - 0.7, (scale - 0.7) ** 2 - 0.3, (scale * 3).sin()], -1)


def read_map(features: Tensor, xy: Tensor) -> Tensor:
    """Sample feature maps (B, C, H, W) bilinearly at positions (B, N, 2); return (B, N, C).

    Positions are clamped to the map. On a CPU this is twenty times as fast as `grid_sample`.
    """
    shape = torch._shape_as_tensor(features)
    last = shape[[3, 2]].to(xy.dtype) - 1
    xy = xy.clamp(min=0).minimum(last)
    origin = xy.floor().minimum(last - 1)
    (right, below), width = (xy - origin).unbind(-1), shape[3]
    image = torch.arange(shape[0], device=xy.device)[:, None] * (shape[2] * width)  # type: ignore[call-overload]
    first = (origin[..., 1] * width + origin[..., 0]).long() + image
    pixels = features.permute(0, 2, 3, 1).flatten(0, 2)
    weights = (1 - right) * (1 - below), right * (1 - below), (1 - right) * below, right * below
    corners = first, first + 1, first + width, first + width + 1
    values = (
        pixels[corner].float() * weight[..., None]
        for corner, weight in zip(corners, weights, strict=True)
    )
    return reduce(torch.add, values)


def turn(descriptors: Tensor, angles: Tensor) -> Tensor:
    """Rotate descriptors (..., 64) by angles (...) in radians, as `turn_descriptors` does."""
    turns = angles[..., None] * torch.from_numpy(FREQUENCIES).to(angles)
    constant, numbers = descriptors.tensor_split([CONSTANT], -1)
    (real, imaginary), (c, s) = numbers.chunk(2, -1), (turns.cos(), turns.sin())
    return torch.cat([constant, c * real - s * imaginary, s * real + c * imaginary], -1)
