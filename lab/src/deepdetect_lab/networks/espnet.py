"""ESPNet: the efficient spatial pyramid network (Mehta et al., ECCV 2018), in torch.

DeepDetect's paper trains ESPNet to predict the fusion mask (Section III-B). Modules have the names
that they have in the published state dict, so that its weights can be loaded.
"""

from __future__ import annotations

from collections import OrderedDict

import torch
from torch import Tensor, nn

EPSILON = 1e-3  # for batch normalisation, as published
DILATIONS = (1, 2, 4, 8, 16)


def _convolution(inputs: int, outputs: int, kernel: int, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, kernel, stride=stride, padding=kernel // 2, bias=False)


def _norm_activation(channels: int, **before: nn.Module) -> nn.Sequential:
    """Chain the modules `before`, a batch normalisation, and a PReLU with a slope per channel."""
    norm = nn.BatchNorm2d(channels, eps=EPSILON)
    return nn.Sequential(OrderedDict(before, bn=norm, act=nn.PReLU(channels)))


class DilatedConvolution(nn.Module):
    """A dilated 3x3 convolution, which computes in float32 on the CPU even under autocast.

    On the CPU, in bfloat16 and with channels_last, PyTorch 2.13 returns NaN or wrong gradients for
    dilated convolutions. Gradients in bfloat16, written for this class, would make a training step
    only 7 % faster than float32.
    """

    def __init__(self, inputs: int, outputs: int, dilation: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 3, padding=dilation, dilation=dilation, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        if x.device.type != "cpu" or not torch.is_autocast_enabled("cpu"):
            return self.conv(x)
        with torch.autocast("cpu", enabled=False):
            return self.conv(x.float())


class SpatialPyramid(nn.Module):
    """A convolution that reduces the channels, then five dilated branches, which are concatenated.

    The reducing convolution has kernel size 1, or kernel size 3 and stride 2, which halves the
    height and width of the features.
    """

    d1: DilatedConvolution
    d2: DilatedConvolution

    def __init__(self, inputs: int, outputs: int, reduce: int) -> None:
        super().__init__()
        narrow = outputs // len(DILATIONS)
        first = outputs - narrow * (len(DILATIONS) - 1)
        reducing = _convolution(inputs, narrow, reduce, stride=2 if reduce == 3 else 1)
        self.c1 = nn.Sequential(OrderedDict(conv=reducing))
        for dilation in DILATIONS:
            width = first if dilation == 1 else narrow
            setattr(self, f"d{dilation}", DilatedConvolution(narrow, width, dilation))

    def branches(self, x: Tensor) -> Tensor:
        """Return the outputs of the branches, partly summed, as one concatenated tensor.

        From dilation 4 on, a branch is replaced by the sum of the branches from dilation 2 up to
        itself.
        """
        reduced = self.c1(x)
        parts = [self.d1(reduced)]
        running = self.d2(reduced)
        parts.append(running)
        for dilation in DILATIONS[2:]:
            running = running + getattr(self, f"d{dilation}")(reduced)
            parts.append(running)
        return torch.cat(parts, 1)


class DownsamplingPyramid(SpatialPyramid):
    """A spatial pyramid that halves the height and width of the features."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, reduce=3)
        self.bn = nn.BatchNorm2d(outputs, eps=EPSILON)
        self.act = nn.PReLU(outputs)

    def forward(self, x: Tensor) -> Tensor:
        return self.act(self.bn(self.branches(x)))


class ResidualPyramid(SpatialPyramid):
    """A spatial pyramid that keeps height and width, with or without a residual connection."""

    def __init__(self, inputs: int, outputs: int, residual: bool = True) -> None:
        super().__init__(inputs, outputs, reduce=1)
        self.residual = residual
        self.bn = _norm_activation(outputs)

    def forward(self, x: Tensor) -> Tensor:
        joined = self.branches(x)
        return self.bn(x + joined if self.residual else joined)


class Encoder(nn.Module):
    """ESPNet's encoder. It returns features at 1/2, 1/4 and 1/8 of the image size."""

    def __init__(self, decoder_channels: int, p: int, q: int) -> None:
        super().__init__()
        self.level1 = _norm_activation(16, conv=_convolution(3, 16, 3, stride=2))
        self.b1 = _norm_activation(16 + 3)
        self.level2_0 = DownsamplingPyramid(16 + 3, 64)
        self.level2 = nn.ModuleList(ResidualPyramid(64, 64) for _ in range(p))
        self.b2 = _norm_activation(128 + 3)
        self.level3_0 = DownsamplingPyramid(128 + 3, 128)
        self.level3 = nn.ModuleList(ResidualPyramid(128, 128) for _ in range(q))
        self.b3 = _norm_activation(256)
        self.classifier = nn.Sequential(OrderedDict(conv=_convolution(256, decoder_channels, 1)))
        self.halve = nn.AvgPool2d(3, stride=2, padding=1)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        half = self.halve(image)
        quarter = self.halve(half)
        level1 = self.b1(torch.cat([self.level1(image), half], 1))
        start = level2 = self.level2_0(level1)
        for block in self.level2:
            level2 = block(level2)
        level2 = self.b2(torch.cat([level2, start, quarter], 1))
        start = level3 = self.level3_0(level2)
        for block in self.level3:
            level3 = block(level3)
        level3 = self.b3(torch.cat([start, level3], 1))
        return level1, level2, level3


class ESPNet(nn.Module):
    """ESPNet predicts a logit for each pixel of an image whose sides are multiples of 8.

    It has `p` residual pyramids at 1/4 of the image size and `q` at 1/8. With the default `p` and
    `q`, it has 408,039 parameters.
    """

    def __init__(self, p: int = 5, q: int = 9, decoder_channels: int = 10) -> None:
        super().__init__()
        width = decoder_channels
        self.encoder = Encoder(width, p, q)
        self.level3_C = nn.Sequential(OrderedDict(conv=_convolution(128 + 3, width, 1)))
        self.br = nn.BatchNorm2d(width, eps=EPSILON)
        self.conv = _norm_activation(width, conv=_convolution(16 + 3 + width, width, 3))
        self.up_l3 = nn.Sequential(_double(width, width))
        self.combine_l2_l3 = nn.Sequential(
            _norm_activation(2 * width), ResidualPyramid(2 * width, width, residual=False)
        )
        self.up_l2 = nn.Sequential(_double(width, width), _norm_activation(width))
        self.classifier = _double(width, 1)

    def forward(self, image: Tensor) -> Tensor:
        """Map (B, 3, H, W) RGB in [0, 1] to (B, 1, H, W) logits."""
        level1, level2, level3 = self.encoder(image)
        eighth = self.up_l3(self.br(self.encoder.classifier(level3)))
        quarter = self.combine_l2_l3(torch.cat([self.level3_C(level2), eighth], 1))
        half = self.conv(torch.cat([self.up_l2(quarter), level1], 1))
        return self.classifier(half)


def _double(inputs: int, outputs: int) -> nn.ConvTranspose2d:
    return nn.ConvTranspose2d(inputs, outputs, 2, stride=2, bias=False)
