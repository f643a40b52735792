"""From an image to a heat map: for each pixel, the probability of a keypoint."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from .._shared.errors import OptionError, unknown_name
from .backends import Network

STRIDE = 8
"""The network halves an image three times, so its sides must be multiples of 8."""

MAX_AUTO_PIXELS = 2_000_000
"""Of an image that the resolution "auto" takes as it is."""


@dataclass(frozen=True)
class HeatmapOptions:
    """How an image is shown to the network.

    Attributes:
        resolution: "native" takes the image as it is. "auto" does so up to two megapixels, and
            scales larger images down to that and the map back: their finest pixels show blur and
            noise more than structure, and the network needs seconds and gigabytes for them. A
            number of pixels squashes the image to a square of that side and the map back, as the
            paper does with 480.
        channels: order of the colours that the network sees. "bgr" is what the paper's
            published code feeds, though the weights were trained on RGB.
        tta: test-time augmentation. "flip" takes the mean of the logits of the image in its eight
            flips and quarter turns: eight times the time, and a flipped or turned image gives the
            same keypoints. Without it about .94 of them are the same.

    Raises:
        OptionError: a value is unknown or out of its range.
    """

    resolution: Literal["auto", "native"] | int = "auto"
    channels: Literal["rgb", "bgr"] = "rgb"
    tta: Literal["none", "flip"] = "none"

    def __post_init__(self) -> None:
        if isinstance(self.resolution, str):
            if self.resolution not in ("auto", "native"):
                known = ["auto", "native", "a number of pixels"]
                raise unknown_name("resolution", self.resolution, known)
        elif (
            not isinstance(self.resolution, (int, np.integer))
            or self.resolution < 16
            or self.resolution % STRIDE
        ):
            raise OptionError(
                f"the resolution must be 'auto', 'native' or a multiple of {STRIDE} from 16 on, "
                f"not {self.resolution}"
            )
        if self.channels not in ("rgb", "bgr"):
            raise unknown_name("channel order", self.channels, ["rgb", "bgr"])
        if self.tta not in ("none", "flip"):
            raise unknown_name("tta", self.tta, ["none", "flip"])


def compute_heatmap(
    rgb: np.ndarray, network: Network, options: HeatmapOptions = HeatmapOptions()
) -> np.ndarray:
    """Run the network on an image.

    Args:
        rgb: (H, W, 3) uint8 RGB.
        network: the loaded network.
        options: the resolution and the order of the channels.

    Returns:
        (H, W) float32 probability in [0, 1], at the image's own pixels. A constant
        image holds nothing to detect: its map is 0 throughout.
    """
    return compute_heatmap_and_logits(rgb, network, options)[0]


def compute_heatmap_and_logits(
    rgb: np.ndarray, network: Network, options: HeatmapOptions = HeatmapOptions()
) -> tuple[np.ndarray, np.ndarray]:
    """Run the network on an image; arguments as of `compute_heatmap`.

    Returns:
        The heat map, and the (H, W) float32 logits of its probabilities. Float32 rounds the
        highest probabilities to 1; logits still distinguish them, so keypoints are ranked by them.
    """
    height, width = rgb.shape[:2]
    if (rgb == rgb[0, 0]).all():
        return np.zeros((height, width), np.float32), np.full((height, width), -np.inf, np.float32)
    shown = rgb if options.channels == "rgb" else rgb[:, :, ::-1]
    whole = height * width <= MAX_AUTO_PIXELS
    if options.resolution == "native" or (options.resolution == "auto" and whole):
        logits = np.ascontiguousarray(_run(network, _pad(shown), options)[:height, :width])
        return _sigmoid(logits), logits
    shown = np.ascontiguousarray(shown)
    if options.resolution == "auto":
        scale = (MAX_AUTO_PIXELS / (height * width)) ** 0.5
        size = [max(STRIDE, round(side * scale / STRIDE) * STRIDE) for side in (width, height)]
        small = cv2.resize(shown, size, interpolation=cv2.INTER_AREA)
    else:
        side = int(options.resolution)
        small = cv2.resize(shown, (side, side), interpolation=cv2.INTER_CUBIC)
    logits = _run(network, small, options)
    heatmap, enlarged = (
        cv2.resize(map_, (width, height), interpolation=cv2.INTER_CUBIC)
        for map_ in (_sigmoid(logits), logits)
    )
    return np.clip(heatmap, 0, 1, out=heatmap), enlarged


def _sigmoid(logits: np.ndarray) -> np.ndarray:
    """Return the probabilities; the exponent is never positive, so that nothing overflows."""
    decay = np.exp(-np.abs(logits))
    return np.where(logits >= 0, np.float32(1), decay) / (1 + decay)


def _pad(rgb: np.ndarray) -> np.ndarray:
    """Repeat the last row and column until both sides are multiples of 8."""
    below, right = -rgb.shape[0] % STRIDE, -rgb.shape[1] % STRIDE
    if not below and not right:
        return rgb
    return np.pad(rgb, ((0, below), (0, right), (0, 0)), mode="edge")


def _run(network: Network, rgb: np.ndarray, options: HeatmapOptions) -> np.ndarray:
    """Return the (H, W) logits of an image whose sides are multiples of 8."""
    if options.tta == "none":
        return _run_once(network, rgb)
    total = np.zeros(rgb.shape[:2], np.float32)
    for turns in range(4):
        turned = np.rot90(rgb, turns)
        for step in (1, -1):
            total += np.rot90(_run_once(network, turned[:, ::step])[:, ::step], -turns)
    total /= 8
    return total


def _run_once(network: Network, rgb: np.ndarray) -> np.ndarray:
    planes = np.empty((1, 3, *rgb.shape[:2]), np.float32)
    np.multiply(rgb.transpose(2, 0, 1), np.float32(1 / 255), out=planes[0])
    return network(planes)[0, 0]
