"""The fast network: plain convolutions of the luma, and a global term of the whole image.

Labels are computed from the luma by detectors with small windows, so a few plain convolutions
suffice. Runtimes compute these faster than dilated branches and sums. But the detectors' thresholds
are relative to the strongest response of the image and to its range of grey levels. So a global
term (histogram of the luma, means and maxima of the features) scales the luma at the start and
gives thresholds for the features before upsampling.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import (
    adaptive_avg_pool2d,
    adaptive_max_pool2d,
    interpolate,
    pixel_shuffle,
    relu,
)

HALF, QUARTER, EIGHTH = 16, 32, 40
"""Numbers of channels at 1/2, 1/4 and 1/8 of the image size. The number at 1/2 is the smallest,
because the layers there take most time."""

RED, GREEN, BLUE = 9798, 19235, 3735
"""Weights of the luma (BT.601) in units of 1/32,768, as in OpenCV."""

BINS = 24
"""Number of bins of the luma's histogram. A value is split between the two nearest bins. Chosen by
hand; not measured."""

HISTOGRAM_STEP_PX = 8
"""The histogram samples every 8th pixel in both directions to save time."""

GAIN_RANGE = (-1, 5)
"""Range of the logarithm of the gain on the luma. It is this large because dark images may span
only 1/100 of the grey levels."""


class Luma(nn.Module):
    """Map (B, 3, H, W) RGB in [0, 1] to (B, 1, H, W), OpenCV's 8-bit luma divided by 255.

    Labels are computed from this luma, and in dark images a single grey level matters. All values
    are integers below 2^24, which float32 holds exactly. It is no convolution, because GPUs would
    round one (TF32).
    """

    def forward(self, image: Tensor) -> Tensor:
        red, green, blue = (image * 255).round().split(1, 1)
        total = RED * red + GREEN * green + BLUE * blue
        return ((total + 16384) * (1 / 32768)).floor() / 255


class Exposure(nn.Module):
    """Map luma (B, 1, H, W) to features (B, BINS + 2, 1, 1), and to its mean (B, 1, 1, 1).

    The features are the logarithms of the histogram's bins, the mean, and the logarithm of the
    variance.
    """

    def forward(self, luma: Tensor) -> tuple[Tensor, Tensor]:
        luma = luma[:, :, ::HISTOGRAM_STEP_PX, ::HISTOGRAM_STEP_PX]
        mean = luma.mean((2, 3), keepdim=True)
        variance = (luma - mean).square().mean((2, 3), keepdim=True)
        bins = torch.arange(BINS, device=luma.device, dtype=luma.dtype)[None, :, None, None]
        shares = relu(1 - (luma * (BINS - 1) - bins).abs()).mean((2, 3), keepdim=True)
        histogram = (shares * BINS + 1e-3).log() * 0.3
        return torch.cat([histogram, mean, (variance + 1e-6).log() * 0.25], 1), mean


class Perceptron(nn.Sequential):
    """Two linear layers with ReLU in between, for (B, C, 1, 1) features."""

    def __init__(self, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, outputs))

    def forward(self, features: Tensor) -> Tensor:
        features = features.flatten(1)
        for layer in self:
            features = layer(features)
        return features[:, :, None, None]


class Convolution(nn.Module):
    """A convolution with batch normalisation and ReLU. A stride of 2 halves the size."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1, kernel: int = 3) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, (kernel - 1) // 2, bias=False)
        self.norm = nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor) -> Tensor:
        return relu(self.norm(self.conv(x)))


class FastNetwork(nn.Module):
    """The fast network predicts a logit per pixel of an image whose sides are multiples of 8.

    It has 57,613 parameters and needs 632 million multiply-adds at 640x480.

    Example:
        >>> FastNetwork()(torch.zeros(1, 3, 16, 24)).shape
        torch.Size([1, 1, 16, 24])
    """

    def __init__(self) -> None:
        super().__init__()
        self.luma, self.exposure = Luma(), Exposure()
        self.gain = Perceptron(BINS + 2, 32, 1)
        nn.init.zeros_(self.gain.get_parameter("2.weight"))
        nn.init.ones_(self.gain.get_parameter("2.bias"))
        self.encode_half = nn.Sequential(
            Convolution(1, HALF, stride=2, kernel=6), Convolution(HALF, HALF)
        )
        self.encode_quarter = Convolution(HALF, QUARTER, stride=2)
        self.encode_eighth = nn.Sequential(
            Convolution(QUARTER, EIGHTH, stride=2), Convolution(EIGHTH, EIGHTH)
        )
        features = HALF + QUARTER + EIGHTH
        self.thresholds = Perceptron(BINS + 2 + 1 + 2 * features, 64, features)
        self.to_quarter = nn.Conv2d(EIGHTH, QUARTER, 1)
        self.to_half = nn.Conv2d(QUARTER, HALF, 1)
        self.at_half = Convolution(HALF, HALF)
        self.logits = nn.Conv2d(HALF, 4, 1)
        nn.init.constant_(
            self.get_parameter("logits.bias"), -1.0
        )  # the logit of about the fraction of marked pixels

    def forward(self, image: Tensor) -> Tensor:
        """Map (B, 3, H, W) RGB in [0, 1] to (B, 1, H, W) logits."""
        # Autocast would round the luma, but the smallest thresholds are a single grey level.
        with torch.autocast(image.device.type, enabled=False):
            luma = self.luma(image)
            exposure, mean = self.exposure(luma)
            gain = self.gain(exposure)
            scaled = (luma - mean) * gain.clamp(*GAIN_RANGE).exp()
        half = self.encode_half(scaled)
        quarter = self.encode_quarter(half)
        eighth = self.encode_eighth(quarter)
        with torch.autocast(image.device.type, enabled=False):
            pooled = [
                pool(features, 1)
                for features in (half, quarter, eighth)
                for pool in (adaptive_avg_pool2d, adaptive_max_pool2d)
            ]
            thresholds = self.thresholds(torch.cat([exposure, gain, *pooled], 1)).to(half.dtype)
        at_eighth, at_quarter, at_half = thresholds.split((EIGHTH, QUARTER, HALF), 1)
        eighth = relu(eighth - at_eighth)
        quarter = relu(quarter + _doubled(self.to_quarter(eighth) - at_quarter))
        half = relu(half + _doubled(self.to_half(quarter) - at_half))
        return pixel_shuffle(self.logits(self.at_half(half)), 2)


def _doubled(features: Tensor) -> Tensor:
    return interpolate(features, scale_factor=2, mode="nearest")
