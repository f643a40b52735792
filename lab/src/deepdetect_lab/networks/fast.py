"""The fast network: plain convolutions of the luma, and a global term from the whole image.

Detectors with small windows compute the labels from the luma, so a few plain convolutions suffice.
Runtimes compute these faster than the dilated branches and sums of ESPNet. But some thresholds of
the detectors depend on the strongest response in the image, and the choice of their settings on the
image's range of grey levels. So a global term is computed from the histogram of the luma and from
means and maxima of the features. It is a gain of the input luma, and thresholds that are subtracted
from the features before upsampling.
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
"""Numbers of channels at 1/2, 1/4 and 1/8 of the image size: fewer in larger maps, to save time."""

RED, GREEN, BLUE = 9798, 19235, 3735
"""Weights of red, green and blue in the luma (BT.601), in units of 1/32,768, as in OpenCV."""

BINS = 24
"""Number of bins of the luma's histogram. Each pixel is divided between the two nearest bins.
Chosen by hand; not measured."""

HISTOGRAM_STEP_PX = 8
"""The histogram counts only every 8th pixel in both directions, to save time. Chosen by hand."""

GAIN_RANGE = (-1, 5)
"""Range of the natural logarithm of the gain that multiplies the luma. The largest gain is 148,
because dark images may span only 1/100 of the grey levels."""


class Luma(nn.Module):
    """Map (B, 3, H, W) RGB in [0, 1] to (B, 1, H, W), OpenCV's 8-bit luma divided by 255.

    Labels are computed from the same luma, and in dark images a single grey level matters. All
    intermediate values are integers below 2^24, which float32 holds exactly. The weighted sum is
    not written as a convolution, because GPUs may compute convolutions in TF32, which rounds.
    """

    def forward(self, image: Tensor) -> Tensor:
        red, green, blue = (image * 255).round().split(1, 1)
        total = RED * red + GREEN * green + BLUE * blue
        return ((total + 16384) * (1 / 32768)).floor() / 255


class Exposure(nn.Module):
    """Map luma (B, 1, H, W) to features (B, BINS + 2, 1, 1) and to the mean luma (B, 1, 1, 1).

    The features are the logarithms of the bins of the luma's histogram, the mean luma, and the
    logarithm of its variance.
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
    """Two linear layers with a ReLU in between, which map features of shape (B, C, 1, 1)."""

    def __init__(self, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, outputs))

    def forward(self, features: Tensor) -> Tensor:
        features = features.flatten(1)
        for layer in self:
            features = layer(features)
        return features[:, :, None, None]


class Convolution(nn.Module):
    """A convolution with batch normalisation and ReLU. A stride of 2 halves height and width."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1, kernel: int = 3) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, (kernel - 1) // 2, bias=False)
        self.norm = nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor) -> Tensor:
        return relu(self.norm(self.conv(x)))


class FastNetwork(nn.Module):
    """The fast network predicts a logit for each pixel of an image whose sides are multiples of 8.

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
        )  # about the logit of the fraction of pixels that labels mark

    def forward(self, image: Tensor) -> Tensor:
        """Map (B, 3, H, W) RGB in [0, 1] to (B, 1, H, W) logits."""
        # Autocast would round the luma, but label detectors have thresholds of one grey level.
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
