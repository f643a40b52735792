"""The network of the learned descriptor: features of the whole image, read at keypoints.

`DescriptorNetwork.maps` makes features at 1/4 to 1/16 of the size of the image; `describe` reads
all of them at each keypoint (bilinearly), and a perceptron makes 64 numbers of them, which the size
of the keypoint modulates. The numbers are those of an upright image: the first 16 do not change
where it is turned, and the others turn with it (`deepdetect.features.learned`).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import grid_sample, interpolate, normalize, relu

from deepdetect.features.learned import CONSTANT, FREQUENCIES

HALF, QUARTER, EIGHTH, SIXTEENTH, COARSEST, HIDDEN = 12, 32, 64, 96, 128, 160
DIMENSIONS = CONSTANT + 2 * len(FREQUENCIES)

SMALLEST_SIZE_PX, SIZE_PER_SIGMA = 2.5, 2.5


class Convolution(nn.Module):
    """A convolution, batch normalisation, ReLU; stride 2 halves the size."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1, kernel: int = 3) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, (kernel - 1) // 2, bias=False)
        self.norm = nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor) -> Tensor:
        return relu(self.norm(self.conv(x)))


class DescriptorNetwork(nn.Module):
    """Describes keypoints of luma whose sides are multiples of 32.

    693,225 parameters, 1.07 billion multiply-adds at 640x480 without those of keypoints, of which
    each takes 75,000.
    """

    def __init__(self) -> None:
        super().__init__()
        self.hf = Convolution(1, HALF, 2, 6)
        self.q = nn.Sequential(Convolution(HALF, QUARTER, 2), Convolution(QUARTER, QUARTER))
        self.e = nn.Sequential(Convolution(QUARTER, EIGHTH, 2), Convolution(EIGHTH, EIGHTH))
        self.x = nn.Sequential(Convolution(EIGHTH, SIXTEENTH, 2), Convolution(SIXTEENTH, SIXTEENTH))
        self.y = nn.Sequential(Convolution(SIXTEENTH, COARSEST, 2), Convolution(COARSEST, COARSEST))
        self.yx, self.xm = nn.Conv2d(COARSEST, SIXTEENTH, 1), Convolution(SIXTEENTH, SIXTEENTH)
        self.xe, self.em = nn.Conv2d(SIXTEENTH, EIGHTH, 1), Convolution(EIGHTH, EIGHTH)
        self.inp = nn.Linear(QUARTER + 2 * EIGHTH + SIXTEENTH, HIDDEN)
        self.film = nn.Sequential(nn.Linear(3, 32), nn.ReLU(), nn.Linear(32, 2 * HIDDEN))
        nn.init.zeros_(self.get_parameter("film.2.weight"))
        nn.init.zeros_(self.get_parameter("film.2.bias"))
        self.norm, self.norm2 = nn.BatchNorm1d(HIDDEN), nn.BatchNorm1d(HIDDEN)
        self.mid, self.out = nn.Linear(HIDDEN, HIDDEN), nn.Linear(HIDDEN, DIMENSIONS)
        self.temp = nn.Parameter(torch.tensor(math.log(20.0)))  # of the loss

    def forward(self, luma: Tensor, xy: Tensor, sizes: Tensor) -> Tensor:
        """Map (B, 1, H, W) in [0, 1], (B, N, 2) and (B, N) pixels to (B, N, 64) of length 1."""
        shape = torch._shape_as_tensor(luma) if torch.jit.is_tracing() else torch.tensor(luma.shape)
        return self.describe(self.maps(luma), xy, sizes, shape[[3, 2]].to(xy.dtype))

    def maps(self, luma: Tensor) -> list[Tensor]:
        """Return features at 1/4, 1/8, again 1/8 with what is around, and 1/16 of the size."""
        mean = luma.mean((2, 3), keepdim=True)
        variance = (luma - mean).square().mean((2, 3), keepdim=True)
        quarter = self.q(self.hf((luma - mean) / (variance + 1e-6).sqrt()))
        eighth = self.e(quarter)
        sixteenth = self.x(eighth)
        sixteenth = self.xm(sixteenth + _doubled(self.yx(self.y(sixteenth))))
        around = self.em(eighth + _doubled(self.xe(sixteenth)))
        return [quarter, eighth, around, sixteenth]

    def describe(self, maps: list[Tensor], xy: Tensor, sizes: Tensor, size: Tensor) -> Tensor:
        """Return descriptors by the features; `size` is (width, height) of the image."""
        grid = ((xy + 0.5) / size * 2 - 1)[:, :, None]
        read = [
            grid_sample(each.float(), grid, align_corners=False, padding_mode="border")[..., 0]
            for each in maps
        ]
        features = self.inp(torch.cat(read, 1).transpose(1, 2)).flatten(0, 1)
        scale = (sizes.clamp(min=SMALLEST_SIZE_PX) / SIZE_PER_SIGMA).flatten().log()[:, None]
        seen = torch.cat([scale - 0.7, (scale - 0.7) ** 2 - 0.3, (scale * 3).sin()], 1)
        gain, shift = self.film(seen).chunk(2, 1)
        features = relu(self.norm(features) * (1 + gain) + shift)
        features = relu(self.norm2(self.mid(features)))
        return normalize(self.out(features), dim=1).view(len(xy), -1, DIMENSIONS)


def turn(descriptors: Tensor, angles: Tensor) -> Tensor:
    """Turn (..., 64) descriptors by (...) radians, as `turn_descriptors` does by degrees."""
    turns = angles[..., None] * torch.from_numpy(FREQUENCIES).to(angles.dtype)
    constant, numbers = descriptors[..., :CONSTANT], descriptors[..., CONSTANT:]
    (real, imaginary), (c, s) = numbers.chunk(2, -1), (turns.cos(), turns.sin())
    return torch.cat([constant, c * real - s * imaginary, s * real + c * imaginary], -1)


def _doubled(features: Tensor) -> Tensor:
    return interpolate(features, scale_factor=2, mode="nearest")
