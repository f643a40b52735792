"""transformers: the network as a model for keypoint detection, with its image processor.

Its keypoints are the dense ones of the heat map. (The best points of all scales need no network.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.errors import OptionError, check_name, require_packages
from .._shared.image_array import fill_planes
from .._shared.opencv import cv2
from .._shared.options import suggest_keywords
from ..detector.heatmap import MAX_AUTO_PIXELS
from ..detector.pretrained import STRIDE, resolve_weights
from ..features.selection import Maps, SelectionOptions, select_from_maps
from .tensors import load_tensor, padded

require_packages("the drop-in for transformers", "transformers", "torch")

import transformers
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, pad
from transformers.utils import ModelOutput

from ..detector.network.weights import NETWORKS, load_network


class DeepDetectConfig(transformers.PretrainedConfig):
    """The name of the network, and which pixels of its heat map become keypoints.

    Args:
        keypoint_threshold: pixels with a probability above it.
        max_keypoints: at most this many, the best ones; None: all.
        nms_radius: of non-maximum suppression in pixels (0: none).
        network: "espnet" or "fast".
        **keywords: of every configuration of transformers.

    Raises:
        OptionError: the network is unknown, or a number out of its range.
    """

    model_type = "deepdetect"

    def __init__(
        self,
        keypoint_threshold: float = 0.5,
        max_keypoints: int | None = None,
        nms_radius: int = 0,
        network: str = "espnet",
        **keywords: Any,
    ) -> None:
        self.keypoint_threshold = keypoint_threshold
        self.max_keypoints = max_keypoints
        self.nms_radius = nms_radius
        check_name("network", network, NETWORKS)
        self.network = network
        self.selection()
        super().__init__(**keywords)

    def selection(self) -> SelectionOptions:
        """Return the options of selection."""
        return SelectionOptions(
            self.keypoint_threshold, max_keypoints=self.max_keypoints, nms_radius=self.nms_radius
        )


LOGIT_OUTSIDE = -100.0
"""Of pixels outside an image, beside larger ones: their probability is 0."""


@dataclass
class DeepDetectKeypointOutput(ModelOutput):
    """What the model returns for a batch of images.

    Attributes:
        loss: the binary cross-entropy, where labels were given.
        logits: (B, H, W) of the probability of a keypoint at each pixel; -100 outside of images
            that are smaller than others of the batch.
        keypoints: (B, N, 2) relative positions (x, y): (0, 0) is the upper left corner of the image
            and (1, 1) its lower right one, so that the centre of the first of W pixels is 0.5 / W.
            `DeepDetectImageProcessor.post_process_keypoint_detection` turns them to pixels.
        scores: (B, N) probabilities.
        mask: (B, N) integers, 1 for keypoints, 0 for what fills the rows of images with fewer.
    """

    loss: Tensor | None = None
    logits: Tensor | None = None
    keypoints: Tensor | None = None
    scores: Tensor | None = None
    mask: Tensor | None = None


class DeepDetectForKeypointDetection(transformers.PreTrainedModel):
    """The network with the selection of keypoints.

    `from_deepdetect()` makes it from the weights inside the package, `save_pretrained` and
    `from_pretrained` are those of transformers, and need no network.

    Args:
        config: the name of the network, whose weights are random.
    """

    config_class = DeepDetectConfig
    base_model_prefix = "deepdetect"
    main_input_name = "pixel_values"

    def __init__(self, config: DeepDetectConfig) -> None:
        super().__init__(config)
        self.network = NETWORKS[config.network]()
        self.post_init()

    @classmethod
    @suggest_keywords
    def from_deepdetect(
        cls,
        weights: str | Path = "default",
        *,
        keypoint_threshold: float = 0.5,
        max_keypoints: int | None = None,
        nms_radius: int = 0,
    ) -> DeepDetectForKeypointDetection:
        """Return the model with weights of DeepDetect, in evaluation mode.

        Args:
            weights: "default", "dense" or "free", the weights inside the package, or a safetensors
                file that `deepdetect train` has written.
            keypoint_threshold, max_keypoints, nms_radius: as of `DeepDetectConfig`.

        Raises:
            WeightsError: the weights are missing, damaged or do not fit.
            OptionError: an option is unknown or out of its range.
        """
        network = load_network(resolve_weights(weights, ".safetensors"))
        name = next(name for name, make in NETWORKS.items() if type(network) is make)
        model = cls(DeepDetectConfig(keypoint_threshold, max_keypoints, nms_radius, name))
        model.network.load_state_dict(network.state_dict())
        return model.eval()

    def forward(
        self,
        pixel_values: Tensor,
        pixel_mask: Tensor | None = None,
        labels: Tensor | None = None,
        return_dict: bool | None = None,
        **keywords: Any,
    ) -> DeepDetectKeypointOutput | tuple[Tensor, ...]:
        """Detect keypoints.

        Args:
            pixel_values: (B, 3, H, W) RGB in [0, 1], as the image processor returns them.
            pixel_mask: (B, H, W), 1 for pixels of the image, at the upper left; None: all are.
            labels: (B, H, W), 1 for keypoints, to train on.
            return_dict: False for a tuple instead of the output by names.
            **keywords: not used; programs that go through all models give some.
        """
        sizes = _sizes(pixel_values, pixel_mask)
        logits = self._logits(pixel_values, sizes)
        loss = None
        if labels is not None:
            weight = None if pixel_mask is None else pixel_mask.to(logits.dtype)
            loss = binary_cross_entropy_with_logits(
                logits, labels.to(logits.dtype), weight, reduction="sum"
            ) / (logits.numel() if weight is None else weight.sum())
        maps = logits.detach().float().cpu().numpy()
        found = [
            select_from_maps(
                Maps.of_logits(np.ascontiguousarray(values[:height, :width])),
                self.config.selection(),
            )
            for values, (height, width) in zip(maps, sizes, strict=True)
        ]
        relative = [
            (points.xy + np.float32(0.5)) / np.array(points.image_size, np.float32)
            for points in found
        ]
        output = DeepDetectKeypointOutput(
            loss=loss,
            logits=logits,
            keypoints=padded(relative, logits.device),  # half precision has multiples of pixels
            scores=padded([points.scores for points in found], logits.device).to(logits.dtype),
            mask=padded([np.ones(len(points), np.int32) for points in found], logits.device),
        )
        if return_dict is None:
            return_dict = getattr(self.config, "return_dict", True)
        return output if return_dict else output.to_tuple()

    def _logits(self, pixel_values: Tensor, sizes: list[tuple[int, int]]) -> Tensor:
        """Run the network on images of equal size together: each gets what it gets alone."""
        shape = (len(sizes), *pixel_values.shape[-2:])
        logits = pixel_values.new_full(shape, LOGIT_OUTSIDE)
        for height, width in set(sizes):
            rows = [row for row, size in enumerate(sizes) if size == (height, width)]
            filled = pad(
                pixel_values[rows, :, :height, :width],
                (0, -width % STRIDE, 0, -height % STRIDE),
                mode="replicate",
            )
            logits[rows, :height, :width] = self.network(filled)[:, 0, :height, :width].to(logits)
        return logits


class DeepDetectImageProcessor(transformers.BaseImageProcessor):
    """Turns images to the tensors that the model takes, and its output to pixels.

    Args:
        max_pixels: images with more are scaled down to that, as `DeepDetect` does; None: none are.
        **keywords: of every image processor of transformers.

    Raises:
        OptionError: the number is not above 0.
    """

    model_input_names = ["pixel_values", "pixel_mask"]  # noqa: RUF012  # as transformers has it

    def __init__(self, max_pixels: int | None = MAX_AUTO_PIXELS, **keywords: Any) -> None:
        if max_pixels is not None and not max_pixels > 0:
            raise OptionError(f"`max_pixels` must be above 0, not {max_pixels}")
        super().__init__(**keywords)
        self.max_pixels = max_pixels

    def preprocess(self, images: Any, return_tensors: Any = None, **keywords: Any) -> Any:
        """Turn images to tensors.

        Args:
            images: one, or a list of them of any sizes: anything `load_image` takes, or (C, H, W)
                tensors in [0, 1], RGB.
            return_tensors: "pt", "np" or None, as everywhere in transformers.
            **keywords: not used.

        Returns:
            "pixel_values" (B, 3, H, W) float32 in [0, 1], the edges of smaller images repeated, and
            "pixel_mask" (B, H, W), 1 inside the images.

        Raises:
            ImageError: an image cannot be read or is not fit.
        """
        loaded = [self._shrunk(load_tensor(image)) for image in _listed(images)]
        height, width = (max(rgb.shape[axis] for rgb in loaded) for axis in (0, 1))
        height, width = height + -height % STRIDE, width + -width % STRIDE
        values = np.empty((len(loaded), 3, height, width), np.float32)
        mask = np.zeros((len(loaded), height, width), np.int64)
        for row, rgb in enumerate(loaded):
            fill_planes(rgb, values[row])
            mask[row, : rgb.shape[0], : rgb.shape[1]] = 1
        tensors = {"pixel_values": values, "pixel_mask": mask}
        return transformers.BatchFeature(tensors, return_tensors)

    def _shrunk(self, rgb: np.ndarray) -> np.ndarray:
        height, width = rgb.shape[:2]
        if self.max_pixels is None or height * width <= self.max_pixels:
            return rgb
        scale = (self.max_pixels / (height * width)) ** 0.5
        size = [max(STRIDE, round(side * scale / STRIDE) * STRIDE) for side in (width, height)]
        return cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)

    def post_process_keypoint_detection(
        self, outputs: DeepDetectKeypointOutput, target_sizes: Tensor | Sequence[tuple[int, int]]
    ) -> list[dict[str, Tensor]]:
        """Turn the model's output to keypoints in pixels.

        Args:
            outputs: of the model.
            target_sizes: (height, width) of each image, before any processing.

        Returns:
            For each image "keypoints" (N, 2), x and y in pixels, the centre of the first pixel
            (0, 0), and "scores" (N,).

        Raises:
            OptionError: there is not one size for each image.
        """
        assert outputs.keypoints is not None
        assert outputs.scores is not None
        assert outputs.mask is not None
        if len(target_sizes) != len(outputs.mask):
            raise OptionError(
                f"{len(outputs.mask)} images need as many `target_sizes`, not {len(target_sizes)}"
            )
        results = []
        for row, (height, width) in enumerate(target_sizes):
            kept = outputs.mask[row] > 0
            size = outputs.keypoints.new_tensor([float(width), float(height)])
            results.append(
                {
                    "keypoints": outputs.keypoints[row][kept] * size - 0.5,
                    "scores": outputs.scores[row][kept],
                }
            )
        return results


def register() -> None:
    """Let transformers' AutoConfig, AutoModel and AutoImageProcessor find these classes.

    Then `AutoModelForKeypointDetection.from_pretrained(folder)` loads what was saved.
    """
    config, model = DeepDetectConfig, DeepDetectForKeypointDetection
    transformers.AutoConfig.register(config.model_type, config, exist_ok=True)
    transformers.AutoModel.register(config, model, exist_ok=True)
    transformers.AutoModelForKeypointDetection.register(config, model, exist_ok=True)
    transformers.AutoImageProcessor.register(
        config, slow_image_processor_class=DeepDetectImageProcessor, exist_ok=True
    )


def _sizes(pixel_values: Tensor, pixel_mask: Tensor | None) -> list[tuple[int, int]]:
    if pixel_mask is None:
        height, width = pixel_values.shape[-2:]
        return [(height, width)] * len(pixel_values)
    inside = pixel_mask > 0
    heights, widths = inside[:, :, 0].sum(dim=1).tolist(), inside[:, 0].sum(dim=1).tolist()
    return list(zip(heights, widths, strict=True))


def _listed(images: Any) -> list[Any]:
    if isinstance(images, (list, tuple)) or getattr(images, "ndim", 0) == 4:
        if not len(images):
            raise OptionError("there are no images: give one or more")
        return list(images)
    return [images]
