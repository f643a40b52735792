"""The network of the learned descriptor: feature maps of the whole image, sampled at keypoints.

`DescriptorNetwork.maps` computes feature maps at 1/2 to 1/16 of the image size, with the same
kernels for three octaves: the image, and the image reduced to 1/2 and 1/4. `features` samples the
maps of the first octave and of the octave that fits the keypoint's size. A perceptron maps the
samples to 64 numbers: 16 that do not change when the image is rotated, and 48 that rotate with the
image (`deepdetect.features.learned`).
"""

from __future__ import annotations

import math
from functools import reduce
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, batch_norm, interpolate, normalize, relu

from deepdetect.features.learned import CONSTANT, FREQUENCIES, LENGTH

HALF, QUARTER, EIGHTH, SIXTEENTH, COARSEST, HIDDEN = 16, 32, 64, 96, 128, 160
"""Numbers of channels of the feature maps, from 1/2 of an octave's size (`HALF`) to 1/32
(`COARSEST`), and number of hidden units of the perceptron (`HIDDEN`). Chosen by hand."""

OCTAVES = 3
FIRST_OCTAVE_PX = 4.5
"""A keypoint up to this diameter is described by maps of the full image only. For a larger one,
maps of the two octaves nearest to its size are interpolated and used as well. Chosen by hand."""

SMALLEST_SIZE_PX = 2.5
"""Keypoints with a smaller diameter are described as if they had this one. Chosen by hand."""

NOISE = 1 / 255
"""One grey level of the luma. Variations with about this standard deviation count as noise: the
normalisation by local contrast does not amplify them to full contrast."""

CELL_PX, CELLS = 8, 5
"""Local contrast is computed in a square of 5x5 cells of 8x8 pixels each. Chosen by hand."""

BATCH_MOMENTUM = 0.1
"""Share of the new batch in the running statistics at each step, the default of torch."""


class Convolution(nn.Module):
    """A convolution with batch normalisation and ReLU.

    In training, all octaves are normalised by the batch statistics of the first octave, because the
    trained network has only one set of running statistics, for all octaves.
    """

    def __init__(self, inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> None:
        super().__init__()
        padding = (kernel - 1) // 2
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, padding, bias=False)
        self.norm = nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor, octave: int) -> Tensor:
        x, norm = self.conv(x), self.norm
        if not self.training:
            return relu(norm(x))
        if octave == 0:
            self.mean, self.variance = (
                x.new_zeros(x.shape[1]).float(),
                x.new_ones(x.shape[1]).float(),
            )
        batch = self.mean, self.variance
        first = octave == 0
        result = relu(batch_norm(x, *batch, norm.weight, norm.bias, training=first, momentum=1))
        if first:
            for running, each in zip((norm.running_mean, norm.running_var), batch, strict=True):
                cast(Tensor, running).lerp_(each, BATCH_MOMENTUM)
        return result


class Halving(nn.Module):
    """Two convolutions. The first halves the width and the height."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.first, self.second = (
            Convolution(inputs, outputs, 2, 2),
            Convolution(outputs, outputs),
        )

    def forward(self, x: Tensor, octave: int) -> Tensor:
        return self.second(self.first(x, octave), octave)


class KeypointNetwork(nn.Module):
    """A network that samples feature maps at keypoints, and makes descriptors from the samples.

    Attributes:
        octaves: number of octaves of which `maps` makes feature maps.
        strides: pixels of the octave per pixel of each of its maps.
    """

    octaves: int
    strides: tuple[int, ...]

    def add_perceptron(self, channels: int, hidden: int) -> None:
        """Add the layers that make descriptors from the samples of the maps.

        `channels` is the total number of channels of an octave's maps, `hidden` the number of
        hidden units.
        """
        self.input = nn.Linear(2 * channels, hidden)
        self.by_size = nn.Sequential(nn.Linear(3, 32), nn.ReLU(), nn.Linear(32, 2 * hidden))
        nn.init.zeros_(self.get_parameter("by_size.2.weight"))
        nn.init.zeros_(self.get_parameter("by_size.2.bias"))
        self.norm, self.middle_norm = nn.BatchNorm1d(hidden), nn.BatchNorm1d(hidden)
        self.middle, self.output = nn.Linear(hidden, hidden), nn.Linear(hidden, LENGTH)
        self.temperature = nn.Parameter(torch.tensor(math.log(20.0)))  # log of 1 / temperature

    def maps(self, luma: Tensor) -> list[list[Tensor]]:
        """Return the feature maps of each octave."""
        raise NotImplementedError

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
                    for features, stride in zip(maps[octave], self.strides, strict=True)
                ],
                2,
            )
            for octave in range(self.octaves)
        ]
        shares = shares_of_octaves(sizes, self.octaves)
        own_octave = reduce(torch.add, map(torch.mul, octaves, shares))
        features = self.input(torch.cat([octaves[0], own_octave], 2)).flatten(0, 1)
        seen = size_features(sizes).flatten(0, 1)
        gain, shift = self.by_size(seen).chunk(2, 1)
        features = relu(self.norm(features) * (1 + gain) + shift)
        return relu(self.middle_norm(self.middle(features)))


class DescriptorNetwork(KeypointNetwork):
    """A network that describes keypoints in luma images whose sides are multiples of 128."""

    octaves = OCTAVES
    strides = (2, 4, 8, 8, 16)

    def __init__(self) -> None:
        super().__init__()
        self.at_half = Convolution(2, HALF, 4, 2)
        self.at_quarter = Halving(HALF, QUARTER)
        self.at_eighth = Halving(QUARTER, EIGHTH)
        self.at_sixteenth = Halving(EIGHTH, SIXTEENTH)
        self.at_coarsest = Halving(SIXTEENTH, COARSEST)
        self.to_sixteenth = nn.Conv2d(COARSEST, SIXTEENTH, 1)
        self.around_sixteenth = Convolution(SIXTEENTH, SIXTEENTH)
        self.to_eighth = nn.Conv2d(SIXTEENTH, EIGHTH, 1)
        self.around_eighth = Convolution(EIGHTH, EIGHTH)
        self.add_perceptron(HALF + QUARTER + 2 * EIGHTH + SIXTEENTH, HIDDEN)

    def maps(self, luma: Tensor) -> list[list[Tensor]]:
        """Return five feature maps of each octave, at 1/2, 1/4, 1/8, 1/8 and 1/16 of its size.

        The last two maps also contain context from coarser maps.
        """
        x, result = _normalized(luma), []
        for octave in range(OCTAVES):
            if octave:
                x = avg_pool2d(x, 2)
            half = self.at_half(x, octave)
            quarter = self.at_quarter(half, octave)
            eighth = self.at_eighth(quarter, octave)
            sixteenth = self.at_sixteenth(eighth, octave)
            coarse = double(self.to_sixteenth(self.at_coarsest(sixteenth, octave)))
            sixteenth = self.around_sixteenth(sixteenth + coarse, octave)
            coarse = double(self.to_eighth(sixteenth))
            around = self.around_eighth(eighth + coarse, octave)
            result.append([half, quarter, eighth, around, sixteenth])
        return result


def shares_of_octaves(sizes: Tensor, octaves: int) -> tuple[Tensor, ...]:
    """Return, for each octave, its interpolation weights (B, N, 1) for diameters (B, N)."""
    sizes = sizes.clamp(min=SMALLEST_SIZE_PX)
    own = (sizes / FIRST_OCTAVE_PX).log2().clamp(0, octaves - 1)[..., None]
    shares = (1 - (own - torch.arange(octaves, device=sizes.device)).abs()).clamp(min=0)
    return shares.split(1, -1)


def size_features(sizes: Tensor) -> Tensor:
    """Return three features (B, N, 3) of the logarithms of keypoint diameters (B, N) in pixels."""
    scale = (sizes.clamp(min=SMALLEST_SIZE_PX) / SMALLEST_SIZE_PX).log()[..., None]
    return torch.cat([scale - 0.7, (scale - 0.7) ** 2 - 0.3, (scale * 3).sin()], -1)


def _normalized(luma: Tensor) -> Tensor:
    """Return (B, 2, H, W): the luma normalised by the image's contrast, and by local contrast."""
    mean = luma.mean((2, 3), keepdim=True)
    variance = (luma - mean).square().mean((2, 3), keepdim=True)
    whole = (luma - mean) / (variance + 1e-6).sqrt()
    local, square = (
        avg_pool2d(avg_pool2d(x, CELL_PX), CELLS, 1, CELLS // 2, count_include_pad=False)
        for x in (luma, luma * luma)
    )
    gain = ((square - local * local).clamp(min=0) + NOISE**2).rsqrt()
    field = torch.cat([local * gain, gain], 1)
    field = interpolate(field, scale_factor=CELL_PX, mode="bilinear", align_corners=False)
    return torch.cat([whole, luma * field[:, 1:] - field[:, :1]], 1)


def double(features: Tensor) -> Tensor:
    """Return maps (B, C, H, W) of twice the height and width, interpolated bilinearly."""
    return interpolate(features, scale_factor=2, mode="bilinear", align_corners=False)


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
