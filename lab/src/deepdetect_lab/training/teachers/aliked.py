"""ALIKED-n16rot in plain torch, to describe and score given points.

The layers and their names are those of the authors' weights file `models/aliked-n16rot.pth`
(github.com/Shiaoming/ALIKED, BSD-3-Clause, copyright 2022 Zhao Xiaoming). Paper: Zhao et al.,
"ALIKED: A Lighter Keypoint and Descriptor Extraction Network via Deformable Transformation", 2023.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn.functional import (
    avg_pool2d,
    grid_sample,
    interpolate,
    max_pool2d,
    normalize,
    pad,
    selu,
)

from deepdetect._shared.errors import MissingWeightsError

LENGTH = 128
"""Length of a descriptor, as in the published weights."""

KERNEL, SAMPLES = 3, 16
"""Convolutions cover 3x3 pixels, and 16 samples make a descriptor, as in the published weights."""

MULTIPLE = 32
"""The coarsest features have 1/32 of the image size, so images are padded to multiples of 32."""

REACH = 0.25
"""Offsets of samples are at most a quarter of the map's longer side, as in the paper's code."""

SCORE_WINDOW = 5
"""A point gets the highest score in a window of 5x5 pixels, since the positions of its keypoint in
DeepDetect and in ALIKED may differ. Chosen by hand."""


class DeformableConvolution(nn.Module):
    """A convolution of 3x3 samples whose positions another convolution predicts."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.offset_conv = nn.Conv2d(inputs, 2 * KERNEL**2, KERNEL, padding=1)
        self.regular_conv = nn.Conv2d(inputs, outputs, KERNEL, padding=1, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        height, width = x.shape[2:]
        limit = REACH * max(height, width)
        offsets = self.offset_conv(x).clamp(-limit, limit)
        y0, x0 = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        parts: list[Tensor] = []
        for k, kernel in enumerate(self.regular_conv.weight.flatten(2).unbind(2)):
            y = y0 + k // KERNEL - 1 + offsets[:, 2 * k]
            place = torch.stack([x0 + k % KERNEL - 1 + offsets[:, 2 * k + 1], y], -1)
            parts.append(torch.einsum("nchw,oc->nohw", _sample(x, place), kernel))
        return torch.stack(parts).sum(0)


class Block(nn.Module):
    """Two convolutions; a `residual` block also adds its input, mapped by a 1x1 convolution."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        make: Callable[[int, int], nn.Module],
        residual: bool = True,
    ) -> None:
        super().__init__()
        self.conv1, self.bn1 = make(inputs, outputs), nn.BatchNorm2d(outputs)
        self.conv2, self.bn2 = make(outputs, outputs), nn.BatchNorm2d(outputs)
        self.downsample = nn.Conv2d(inputs, outputs, 1) if residual else None

    def forward(self, x: Tensor) -> Tensor:
        result: Tensor = self.bn2(self.conv2(selu(self.bn1(self.conv1(x)))))
        return selu(result if self.downsample is None else result + self.downsample(x))


class DescriptorHead(nn.Module):
    """Descriptors of given points, each a combination of samples at predicted offsets."""

    def __init__(self) -> None:
        super().__init__()
        count = 2 * SAMPLES
        first = nn.Conv2d(LENGTH, count, KERNEL)
        self.offset_conv = nn.Sequential(first, nn.SELU(), nn.Conv2d(count, count, 1))
        self.sf_conv = nn.Conv2d(LENGTH, LENGTH, 1, bias=False)
        self.agg_weights = nn.Parameter(torch.rand(SAMPLES, LENGTH, LENGTH))

    def forward(self, features: Tensor, xy: Tensor) -> Tensor:
        """Return (N, 128) unit descriptors at (N, 2) pixel positions in features (1, 128, H, W)."""
        height, width = features.shape[2:]
        # As in the published code, positions are rounded towards zero, and patches at the border
        # are moved inwards, by one pixel more on the right and at the bottom.
        last = torch.tensor([width, height]) - 1 - KERNEL
        corner = (xy.trunc() - 0.5).long().clamp(min=0).minimum(last)
        across = torch.arange(KERNEL)
        rows, columns = (corner[:, k, None] + across for k in (1, 0))
        patches = features[0][:, rows[:, :, None], columns[:, None]].transpose(0, 1)
        limit = REACH * max(height, width)
        offsets = self.offset_conv(patches).clamp(-limit, limit).view(-1, 2, SAMPLES)
        places = xy[:, None] + offsets.transpose(1, 2)
        samples = _sample(features, places[None])
        samples = selu(self.sf_conv(samples))[0]
        return normalize(torch.einsum("cks,sco->ko", samples, self.agg_weights), dim=1)


class Aliked(nn.Module):
    """ALIKED-n16rot, without its own keypoint detection."""

    def __init__(self) -> None:
        super().__init__()
        self.block1 = Block(3, 16, _plain, residual=False)
        self.block2 = Block(16, 32, _plain)
        self.block3 = Block(32, 64, DeformableConvolution)
        self.block4 = Block(64, 128, DeformableConvolution)
        parts = (nn.Conv2d(width, LENGTH // 4, 1, bias=False) for width in (16, 32, 64, 128))
        self.conv1, self.conv2, self.conv3, self.conv4 = parts
        layers: list[nn.Module] = [nn.Conv2d(LENGTH, 8, 1, bias=False)]
        for inputs, outputs in ((8, 4), (4, 4), (4, 1)):
            layers += [nn.SELU(), nn.Conv2d(inputs, outputs, KERNEL, padding=1, bias=False)]
        self.score_head = nn.Sequential(*layers)
        self.desc_head = DescriptorHead()

    def maps(self, rgb: Tensor) -> tuple[Tensor, Tensor]:
        """Return features (1, 128, H, W) and scores (1, 1, H, W) of RGB (1, 3, H, W) in [0, 1]."""
        height, width = rgb.shape[2:]
        left, top = (-width % MULTIPLE) // 2, (-height % MULTIPLE) // 2
        around = left, -width % MULTIPLE - left, top, -height % MULTIPLE - top
        first = self.block1(pad(rgb, around, mode="replicate"))
        second = self.block2(avg_pool2d(first, 2))
        third = self.block3(avg_pool2d(second, 4))
        fourth = self.block4(avg_pool2d(third, 4))
        parts = [selu(self.conv1(first))]
        for x, layer in ((second, self.conv2), (third, self.conv3), (fourth, self.conv4)):
            size = first.shape[2:]
            parts.append(interpolate(selu(layer(x)), size, mode="bilinear", align_corners=True))
        features = torch.cat(parts, 1)
        inside = (..., slice(top, top + height), slice(left, left + width))
        scores = self.score_head(features).sigmoid()[inside]
        features = features[inside]
        # This is four times as fast as `normalize`, whose sum over channels is slow on a CPU.
        return features * features.square().sum(1, keepdim=True).rsqrt(), scores

    @torch.no_grad()
    def forward(self, rgb: Tensor, xy: Tensor) -> tuple[Tensor, Tensor]:
        """Return (N, 128) descriptors and (N,) scores at positions (N, 2), in pixels."""
        features, scores = self.maps(rgb)
        highest = max_pool2d(scores, SCORE_WINDOW, 1, SCORE_WINDOW // 2)[0, 0]
        last = torch.tensor([scores.shape[3], scores.shape[2]]) - 1
        x, y = xy.round().long().clamp(min=0).minimum(last).unbind(1)
        return self.desc_head(features, xy), highest[y, x]


def load_aliked(path: Path) -> Aliked:
    """Load the authors' file `aliked-n16rot.pth`."""
    if not path.is_file():
        raise MissingWeightsError(
            f"there is no {path}: take aliked-n16rot.pth from github.com/Shiaoming/ALIKED"
        )
    network = Aliked()
    network.load_state_dict(torch.load(path, "cpu", weights_only=True))
    return network.eval()


def _plain(inputs: int, outputs: int) -> nn.Module:
    return nn.Conv2d(inputs, outputs, KERNEL, padding=1, bias=False)


def _sample(features: Tensor, places: Tensor) -> Tensor:
    """Sample maps bilinearly at positions (1, H, W, 2), in pixels; samples outside are 0."""
    size = torch.tensor([features.shape[3], features.shape[2]]) - 1
    return grid_sample(features, 2 * places / size - 1, align_corners=True)
