"""The head that ranks keypoints: from grey to a logit for each pixel.

It sees an image at one scale; keypoints of all scales are found on a pyramid (`detector.points`).
The logit is linear in classical responses, which are computed inside, plus a small convolutional
network whose last layer starts at almost nothing: an untrained head ranks as |det H| does.
"""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, conv2d, interpolate, pad, relu

HESSIAN_SIGMAS_PX = (1.0, 1.5, 2.0, 2.8, 4.0)
CORNER_SIGMAS_PX = ((0.8, 1.0), (1.2, 1.6), (2.0, 2.6))
"""Of the derivatives, and of the window that their products are averaged in."""

LOCAL_SIGMA_PX = 5.0
INITIAL_SIGMA_PX = 1.5
"""Of 1, 1.5, 2 and 2.8 the best start on a pyramid by the hard measure on photos/val."""
RESPONSES = len(HESSIAN_SIGMAS_PX) + len(CORNER_SIGMAS_PX) + 2

HESSIAN_FLOOR = 1e-7
CORNER_FLOOR = 1e-6
CONTRAST_FLOOR = 0.02
"""Added so that noise in flat places (grey in [0, 1]) does not look like structure."""

LOG_CENTER, LOG_SCALE = -8.0, 3.0
"""Logarithms of responses of photographs are about this, give or take."""

INITIAL_OUTPUT = 1e-3

MAX_DENSE_SIDE = 512
"""Larger images are smoothed by convolutions."""

STRIDE = 4


class PointsHead(nn.Module):
    """Logits of keypoints at full resolution, from grey at full, half and quarter resolution.

    Args:
        channels: of the convolutions at full, half and quarter resolution.
        initial_sigma_px: one of `HESSIAN_SIGMAS_PX`; an untrained head ranks by its response.

    Example:
        >>> PointsHead()(torch.zeros(1, 1, 16, 24)).shape
        torch.Size([1, 1, 16, 24])
    """

    def __init__(
        self,
        channels: tuple[int, int, int] = (12, 16, 24),
        initial_sigma_px: float = INITIAL_SIGMA_PX,
    ) -> None:
        super().__init__()
        full, half, quarter = channels
        self.classical = nn.Conv2d(RESPONSES, 1, 1)
        self.at_full = _block(RESPONSES, full)
        self.at_half = _block(full, half)
        self.at_quarter = _block(half, quarter)
        self.to_half = nn.Conv2d(quarter, half, 1)
        self.join_half = nn.Conv2d(half, half, 3, padding=1)
        self.to_full = nn.Conv2d(half, full, 1)
        self.join_full = nn.Conv2d(full, full, 3, padding=1)
        self.output = nn.Conv2d(full, 1, 3, padding=1)
        with torch.no_grad():
            for parameter in (self.classical.weight, self.classical.bias, self.output.bias):
                if parameter is not None:
                    parameter.zero_()
            self.classical.weight[0, HESSIAN_SIGMAS_PX.index(initial_sigma_px)] = 1.0
            self.output.weight.mul_(INITIAL_OUTPUT)

    def forward(self, gray: Tensor) -> Tensor:
        """Compute logits.

        Args:
            gray: (B, 1, H, W) in [0, 1], of any size.

        Returns:
            (B, 1, H, W).
        """
        height, width = gray.shape[-2:]
        padded = pad(gray, (0, -width % STRIDE, 0, -height % STRIDE), mode="replicate")
        responses = classical_responses(padded).contiguous(memory_format=torch.channels_last)
        full = self.at_full(responses)
        half = self.at_half(avg_pool2d(full, 2))
        quarter = self.at_quarter(avg_pool2d(half, 2))
        half = relu(self.join_half(half + _enlarged(self.to_half(quarter))))
        full = relu(self.join_full(full + _enlarged(self.to_full(half))))
        logits: Tensor = self.classical(responses) + self.output(full)
        return logits[..., :height, :width]


def classical_responses(gray: Tensor) -> Tensor:
    """Compute what the head sees: (B, `RESPONSES`, H, W) from (B, 1, H, W) in [0, 1].

    log |det H| sigma^4 and the log of the smaller eigenvalue of the structure tensor (Shi and
    Tomasi) at some scales, grey less its local mean, and that over its local deviation.
    """
    channels = []
    for sigma in HESSIAN_SIGMAS_PX:
        xx, yy, xy = _second_differences(_blurred(gray, sigma))
        response = (xx * yy - xy * xy).abs() * sigma**4
        channels.append(_log(response, HESSIAN_FLOOR))
    for derivative, window in CORNER_SIGMAS_PX:
        smooth = pad(_blurred(gray, derivative), (1, 1, 1, 1), mode="replicate")
        dx = (smooth[..., 1:-1, 2:] - smooth[..., 1:-1, :-2]) / 2
        dy = (smooth[..., 2:, 1:-1] - smooth[..., :-2, 1:-1]) / 2
        products = torch.cat([dx * dx, dy * dy, dx * dy])
        xx, yy, xy = _blurred(products * derivative**2, window).chunk(3)
        spread = ((xx - yy).square() + 4 * xy.square() + 1e-12).sqrt()
        channels.append(_log((xx + yy - spread).clamp(min=0) / 2, CORNER_FLOOR))
    centred = gray - _blurred(gray, LOCAL_SIGMA_PX)
    deviation = _blurred(centred.square(), LOCAL_SIGMA_PX).sqrt()
    channels += [5 * centred, centred / (deviation + CONTRAST_FLOOR)]
    return torch.cat(channels, 1)


def _log(response: Tensor, floor: float) -> Tensor:
    return ((response + floor).log() - LOG_CENTER) / LOG_SCALE


def _block(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, padding=1),
        nn.ReLU(),
        nn.Conv2d(outputs, outputs, 3, padding=1),
        nn.ReLU(),
    )


def _enlarged(x: Tensor) -> Tensor:
    return interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)


def _second_differences(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return xx, yy and xy of (B, 1, H, W), with the border repeated."""
    p = pad(x, (1, 1, 1, 1), mode="replicate")
    rows, columns = p[..., 1:-1, :], p[..., 1:-1]
    xx = rows[..., 2:] - 2 * x + rows[..., :-2]
    yy = columns[..., 2:, :] - 2 * x + columns[..., :-2, :]
    xy = (p[..., 2:, 2:] - p[..., 2:, :-2] - p[..., :-2, 2:] + p[..., :-2, :-2]) / 4
    return xx, yy, xy


def _blurred(x: Tensor, sigma: float) -> Tensor:
    """Smooth (B, 1, H, W) by a Gaussian, with the border repeated."""
    height, width = x.shape[-2:]
    if max(height, width) <= MAX_DENSE_SIDE and not torch.onnx.is_in_onnx_export():
        # Products of matrices are several times faster than convolutions of one channel.
        smooth = _blur_matrix(height, sigma) @ x @ _blur_matrix(width, sigma).T
        return smooth
    kernel = x.new_tensor(_gaussian(sigma))
    radius = len(kernel) // 2
    wide = conv2d(pad(x, (radius, radius, 0, 0), mode="replicate"), kernel.view(1, 1, 1, -1))
    return conv2d(pad(wide, (0, 0, radius, radius), mode="replicate"), kernel.view(1, 1, -1, 1))


def _gaussian(sigma: float) -> list[float]:
    radius = math.ceil(3 * sigma)
    weights = [math.exp(-((k / sigma) ** 2) / 2) for k in range(-radius, radius + 1)]
    return [weight / sum(weights) for weight in weights]


@lru_cache(maxsize=256)
def _blur_matrix(side: int, sigma: float) -> Tensor:
    """Return the (side, side) matrix that smooths a column."""
    kernel = torch.tensor(_gaussian(sigma))
    radius = len(kernel) // 2
    matrix = torch.zeros(side, side)
    rows = torch.arange(side)
    for k, weight in enumerate(kernel):
        matrix[rows, (rows + k - radius).clamp(0, side - 1)] += weight
    return matrix
