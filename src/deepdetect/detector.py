"""The detector: an image in, a heat map or keypoints out."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any, Literal

import numpy as np

from .bundled import find_weights
from .heatmap import HeatmapOptions, compute_heatmap
from .image import load_image
from .keypoints import Keypoints, SelectionOptions, select_keypoints
from .runtime import RuntimeOptions, open_network


class DeepDetect:
    """The dense keypoint detector of the paper.

    Args:
        weights: "matching" or "geometry", the weights inside the package; or an ONNX file, or
            a safetensors file where torch is installed.
        resolution: "native" (the image as it is, padded), or a number of pixels: the
            image is squashed to a square of that side, as the paper does with 480.
        backend: "auto" (OpenVINO when it is installed, else ONNX Runtime; torch for
            safetensors), "onnxruntime", "openvino" or "torch".
        providers: ONNX Runtime's execution providers by name, as
            ("CUDAExecutionProvider", "CPUExecutionProvider").
        threads: number of threads; None leaves the backend's choice.
        channels: "rgb", or "bgr" as the paper's published code feeds them.

    Attributes:
        backend: name of the backend that runs.
        heatmap_options: the resolution and the order of the channels.

    Raises:
        WeightsError: the weights are missing, damaged or do not fit.
        OptionError: an option is unknown or out of its range.
        MissingExtraError: the backend is not installed.

    Example:
        >>> import numpy as np
        >>> image = np.zeros((48, 64), np.uint8)
        >>> image[16:32, 16:48] = 255
        >>> detector = DeepDetect()
        >>> detector.heatmap(image).shape
        (48, 64)
        >>> len(detector.detect(image, max_keypoints=10))
        10
    """

    def __init__(
        self,
        weights: str | Path = "matching",
        *,
        resolution: Literal["native"] | int = "native",
        backend: str = "auto",
        providers: tuple[str, ...] = (),
        threads: int | None = None,
        channels: Literal["rgb", "bgr"] = "rgb",
    ) -> None:
        self.weights = find_weights(weights)
        self.heatmap_options = HeatmapOptions(resolution, channels)
        self._runtime = RuntimeOptions(backend, providers, threads)
        self._network, self.backend = open_network(self.weights, self._runtime)

    def configured(self, heatmap_options: HeatmapOptions) -> DeepDetect:
        """Return a detector with the same loaded network and other heat map options."""
        other = copy.copy(self)
        other.heatmap_options = heatmap_options
        return other

    def with_weights(self, weights: str | Path) -> DeepDetect:
        """Return a detector with other weights, and all other options as they are.

        Raises:
            WeightsError: the weights are missing, damaged or do not fit.
        """
        other = self.configured(self.heatmap_options)
        other.weights = find_weights(weights)
        other._network, other.backend = open_network(other.weights, self._runtime)
        return other

    def heatmap(self, image: Any) -> np.ndarray:
        """Compute the probability of a keypoint at each pixel.

        Args:
            image: a path, a PIL image, or an array: uint8, uint16 or float in [0, 1];
                grey, RGB or RGBA.

        Returns:
            (H, W) float32 in [0, 1], at the image's own size.

        Raises:
            ImageError: the image cannot be read or is not fit.
        """
        return compute_heatmap(load_image(image), self._network, self.heatmap_options)

    def detect(
        self,
        image: Any,
        threshold: float = 0.5,
        *,
        density: float | None = None,
        max_keypoints: int | None = None,
        nms_radius: int = 0,
        ignore: np.ndarray | None = None,
    ) -> Keypoints:
        """Detect keypoints.

        Args:
            image: as for `heatmap`.
            threshold: tau: pixels with a probability above it.
            density: wanted keypoints a pixel, in (0, 1], instead of the threshold. So many
                are returned even where there is little to detect.
            max_keypoints: keep the most probable so many.
            nms_radius: keep only the most probable of pixels so close, in pixels.
            ignore: (H, W) array, true where no keypoint is wanted.

        Returns:
            The keypoints, on pixel centres, in the order of rows and columns.

        Raises:
            ImageError: the image cannot be read or is not fit.
            OptionError: an option is out of its range.
        """
        options = SelectionOptions(threshold, density, max_keypoints, nms_radius, ignore)
        return select_keypoints(self.heatmap(image), options)
