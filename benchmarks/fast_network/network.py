"""The fast network: plain 3x3 convolutions of the luma, and what the whole image is like.

A label is local, but its thresholds are not: they depend on the strongest response anywhere and on
the range of the grey levels. So convolutions at 1/2, 1/4 and 1/8 of the size see the pixels, and a
global term (histogram of the luma, means and maxima of the features) scales the image at the start
and shifts the features before they are enlarged again.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import (
    adaptive_avg_pool2d,
    adaptive_max_pool2d,
    interpolate,
    pixel_shuffle,
    pixel_unshuffle,
    relu,
)

HALF, QUARTER, EIGHTH = 16, 32, 40
"""Channels at these sizes of the image; most of the time is spent at half of it."""

BINS = 24
"""Of the histogram of the luma; a value counts for the two bins beside it."""

HISTOGRAM_STEP_PX = 8
"""Every so many pixels, in both directions, one is counted."""


class Convolution(nn.Module):
    """A 3x3 convolution, batch normalisation, ReLU; stride 2 halves the size."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.norm = nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor) -> Tensor:
        return relu(self.norm(self.conv(x)))


class FastNetwork(nn.Module):
    """Maps (B, 1, H, W) luma in [0, 1] to logits of the same shape; sides are multiples of 8.

    65,069 parameters, 671 million multiply-adds at 640x480.

    Example:
        >>> FastNetwork()(torch.zeros(1, 1, 16, 24)).shape
        torch.Size([1, 1, 16, 24])
    """

    def __init__(self) -> None:
        super().__init__()
        self.gain = nn.Sequential(nn.Linear(BINS + 2, 32), nn.ReLU(), nn.Linear(32, 1))
        nn.init.zeros_(self.gain[2].weight)
        nn.init.ones_(self.gain[2].bias)
        self.encode_half = nn.Sequential(Convolution(4, HALF), Convolution(HALF, HALF))
        self.encode_quarter = Convolution(HALF, QUARTER, stride=2)
        self.encode_eighth = nn.Sequential(
            Convolution(QUARTER, EIGHTH, stride=2), Convolution(EIGHTH, EIGHTH)
        )
        statistics = BINS + 2 + 1 + 2 * (HALF + QUARTER + EIGHTH)
        self.shifts = nn.Sequential(
            nn.Linear(statistics, 64), nn.ReLU(), nn.Linear(64, EIGHTH + QUARTER + HALF)
        )
        self.to_quarter = nn.Conv2d(EIGHTH, QUARTER, 1)
        self.at_quarter = Convolution(QUARTER, QUARTER)
        self.to_half = nn.Conv2d(QUARTER, HALF, 1)
        self.logits = nn.Conv2d(HALF, 4, 3, padding=1)
        nn.init.constant_(self.logits.bias, -1.0)

    def forward(self, luma: Tensor) -> Tensor:
        # Float16 and bfloat16 would round the luma, of which low thresholds are a grey level.
        with torch.autocast(luma.device.type, enabled=False):
            histogram, mean = histogram_of(luma.float())
            gain = self.gain(histogram)
            scaled = (luma.float() - mean) * gain.clamp(-1, 5).exp()[:, :, None, None]
        half = self.encode_half(pixel_unshuffle(scaled, 2))
        quarter = self.encode_quarter(half)
        eighth = self.encode_eighth(quarter)
        with torch.autocast(luma.device.type, enabled=False):
            pooled = [each for features in (half, quarter, eighth) for each in pools(features)]
            shifts = self.shifts(torch.cat([histogram, gain, *pooled], 1))
        at_eighth, at_quarter, at_half = (
            shift[:, :, None, None].to(half.dtype)
            for shift in shifts.split((EIGHTH, QUARTER, HALF), 1)
        )
        eighth = relu(eighth + at_eighth)
        quarter = relu(quarter + doubled(self.to_quarter(eighth)) + at_quarter)
        quarter = self.at_quarter(quarter)
        half = relu(half + doubled(self.to_half(quarter)) + at_half)
        return pixel_shuffle(self.logits(half), 2)


def histogram_of(luma: Tensor) -> tuple[Tensor, Tensor]:
    """Return (B, BINS + 2) logarithms of the histogram, mean, logarithm of the variance; the mean.

    The mean comes back as (B, 1, 1, 1), too.
    """
    values = luma[:, :, ::HISTOGRAM_STEP_PX, ::HISTOGRAM_STEP_PX].flatten(2)
    mean = values.mean(2)
    variance = (values - mean[:, :, None]).square().mean(2)
    bins = torch.arange(BINS, device=luma.device, dtype=luma.dtype)[None, :, None]
    shares = relu(1 - (values * (BINS - 1) - bins).abs()).mean(2)
    histogram = (shares * BINS + 1e-3).log() * 0.3
    return torch.cat([histogram, mean, (variance + 1e-6).log() * 0.25], 1), mean[:, :, None, None]


def pools(features: Tensor) -> tuple[Tensor, Tensor]:
    """Return the means and the maxima of (B, C, H, W) features, (B, C) each."""
    return (
        adaptive_avg_pool2d(features, 1).flatten(1).float(),
        adaptive_max_pool2d(features, 1).flatten(1).float(),
    )


def doubled(features: Tensor) -> Tensor:
    """Repeat each pixel in both directions."""
    return interpolate(features, scale_factor=2, mode="nearest")
