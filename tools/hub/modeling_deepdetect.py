"""DeepDetect for transformers: the dense keypoints of its network (code and weights: MIT)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch.nn.functional import binary_cross_entropy_with_logits, max_pool2d, pad
from torch.nn.utils.rnn import pad_sequence
from transformers import BaseImageProcessor, BatchFeature, PreTrainedConfig, PreTrainedModel
from transformers.image_utils import load_image
from transformers.utils import ModelOutput

from .network import Network

STRIDE = 8
"""The network's input has sides that are multiples of this many pixels."""

LOGIT_OUTSIDE = -100.0
"""Logit of the padding of smaller images in a batch. Its probability is 0."""


class DeepDetectConfig(PreTrainedConfig):
    """The selection of pixels as keypoints.

    Args:
        keypoint_threshold: pixels with a higher probability become keypoints.
        max_keypoints: only this number of the most probable keypoints is returned. None: all.
        nms_radius: radius of non-maximum suppression in pixels (0: none).
    """

    model_type = "deepdetect"

    keypoint_threshold: float = 0.5
    max_keypoints: int | None = None
    nms_radius: int = 0


@dataclass
class DeepDetectKeypointOutput(ModelOutput):
    """The model's output for a batch of images.

    Attributes:
        loss: the binary cross-entropy, if labels were given.
        logits: (B, H, W) logits of the probability of a keypoint at each pixel.
        keypoints: (B, N, 2) relative positions (x, y), where (0, 0) is the upper left corner of the
            image and (1, 1) the lower right; `post_process_keypoint_detection` gives pixels.
        scores: (B, N) probabilities.
        mask: (B, N), 1 for keypoints, 0 for padding of images with fewer keypoints.
    """

    loss: torch.Tensor | None = None
    logits: torch.Tensor | None = None
    keypoints: torch.Tensor | None = None
    scores: torch.Tensor | None = None
    mask: torch.Tensor | None = None


class DeepDetectForKeypointDetection(PreTrainedModel):
    """The network, followed by the selection of keypoints."""

    config_class = DeepDetectConfig
    base_model_prefix = "network"
    main_input_name = "pixel_values"

    def __init__(self, config: DeepDetectConfig) -> None:
        super().__init__(config)
        self.network = Network()
        self.post_init()

    def forward(
        self,
        pixel_values: torch.Tensor,
        pixel_mask: torch.Tensor | None = None,
        labels: torch.Tensor | None = None,
        return_dict: bool | None = None,
        **_: Any,
    ) -> DeepDetectKeypointOutput | tuple[torch.Tensor, ...]:
        """Detect keypoints.

        Args:
            pixel_values: (B, 3, H, W) RGB in [0, 1].
            pixel_mask: (B, H, W), 1 for pixels of the image, which is at the upper left. None: no
                padding.
            labels: (B, H, W), 1 for keypoints, for training.
            return_dict: False returns a tuple instead of `DeepDetectKeypointOutput`.
        """
        if pixel_mask is None:
            pixel_mask = torch.ones_like(pixel_values[:, 0], dtype=torch.bool)
        inside = pixel_mask > 0
        sizes = [(int(one[:, 0].sum()), int(one[0].sum())) for one in inside]
        logits = pixel_values.new_full(inside.shape, LOGIT_OUTSIDE)
        for height, width in set(sizes):  # padding must not change the result of an image
            rows = [row for row, size in enumerate(sizes) if size == (height, width)]
            image = pixel_values[rows, :, :height, :width]
            padded = pad(image, (0, -width % STRIDE, 0, -height % STRIDE), mode="replicate")
            found = self.network(padded)[:, 0, :height, :width]
            logits[rows, :height, :width] = found.to(logits)
        loss = None
        if labels is not None:
            loss = binary_cross_entropy_with_logits(logits[inside], labels[inside].to(logits))
        chosen = [
            self._select(one[:height, :width].detach().float())
            for one, (height, width) in zip(logits, sizes, strict=True)
        ]
        keypoints, scores, mask = (pad_sequence(part, True) for part in zip(*chosen, strict=True))
        output = DeepDetectKeypointOutput(loss, logits, keypoints, scores.to(logits), mask)
        return output.to_tuple() if return_dict is False else output

    def _select(self, logits: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return relative positions, scores and a mask of ones for keypoints of (H, W) logits."""
        most, radius = self.config.max_keypoints, self.config.nms_radius
        kept = logits.sigmoid() > self.config.keypoint_threshold
        if radius:
            kept &= logits == max_pool2d(logits[None], 2 * radius + 1, 1, radius)[0]
        places, flat = kept.flatten().nonzero()[:, 0], logits.flatten()
        if most is not None and most < len(places):
            places = places[flat[places].topk(most).indices].sort().values
        width = logits.shape[1]
        xy = torch.stack([places % width, places // width], 1)
        size = torch.tensor(logits.shape[::-1], device=xy.device)
        return (xy + 0.5) / size, flat[places].sigmoid(), torch.ones_like(places, dtype=torch.int32)


class DeepDetectImageProcessor(BaseImageProcessor):
    """Converts images to input tensors of the model, and its output to pixels.

    Args:
        max_pixels: larger images are scaled down to this number of pixels. None: never.
    """

    model_input_names = ["pixel_values", "pixel_mask"]  # noqa: RUF012  # as in transformers

    def __init__(self, max_pixels: int | None = 2_000_000, **keywords: Any) -> None:
        super().__init__(**keywords)
        self.max_pixels = max_pixels

    def preprocess(self, images: Any, return_tensors: Any = None, **_: Any) -> BatchFeature:
        """Convert an image or a list of images, of any sizes, to tensors.

        Images are paths, PIL images, arrays or tensors. Arrays and tensors are uint8 or floats in
        [0, 1], grey or RGB, with channels first or last.
        """
        several = isinstance(images, (list, tuple)) or getattr(images, "ndim", 0) == 4
        planes = [self._shrunk(_planes(image)) for image in (images if several else [images])]
        height, width = (max(each.shape[axis] for each in planes) for axis in (1, 2))
        height, width = height + -height % STRIDE, width + -width % STRIDE
        values, mask = [], torch.zeros(len(planes), height, width, dtype=torch.int64)
        for row, each in enumerate(planes):
            _, rows, columns = each.shape
            values.append(np.pad(each, ((0, 0), (0, height - rows), (0, width - columns)), "edge"))
            mask[row, :rows, :columns] = 1
        tensors = {"pixel_values": np.stack(values), "pixel_mask": mask.numpy()}
        return BatchFeature(tensors, return_tensors)

    def _shrunk(self, planes: np.ndarray) -> np.ndarray:
        area = planes.shape[1] * planes.shape[2]
        if self.max_pixels is None or area <= self.max_pixels:
            return planes
        for axis in (1, 2):
            side = planes.shape[axis] * (self.max_pixels / area) ** 0.5
            planes = _averaged(planes, axis, STRIDE * max(1, round(side / STRIDE)))
        return planes

    def post_process_keypoint_detection(
        self,
        outputs: DeepDetectKeypointOutput,
        target_sizes: torch.Tensor | Sequence[tuple[int, int]],
    ) -> list[dict[str, torch.Tensor]]:
        """Convert the model's output to keypoints in pixels.

        Args:
            outputs: output of the model.
            target_sizes: (height, width) of each image, before any processing.

        Returns:
            For each image "keypoints" (N, 2), x and y in pixels, where the centre of the first
            pixel is (0, 0), and "scores" (N,).
        """
        results = []
        parts = (outputs.keypoints, outputs.scores, outputs.mask > 0, target_sizes)
        for keypoints, scores, kept, (height, width) in zip(*parts, strict=True):
            size = keypoints.new_tensor([float(width), float(height)])
            results.append({"keypoints": keypoints[kept] * size - 0.5, "scores": scores[kept]})
        return results


def _planes(image: Any) -> np.ndarray:
    """Convert an image to (3, H, W) float32 RGB in [0, 1]."""
    if not hasattr(image, "ndim"):
        image = load_image(image if hasattr(image, "convert") else str(image))
    array = np.asarray(image)
    if array.ndim == 2:
        array = array[None]
    elif array.shape[2] in (1, 3, 4):
        array = array.transpose(2, 0, 1)
    array = np.repeat(array, 3, 0) if len(array) == 1 else array[:3]
    return np.float32(array) / np.float32(255 if array.dtype == np.uint8 else 1)


def _averaged(planes: np.ndarray, axis: int, count: int) -> np.ndarray:
    """Scale an axis to `count` by averaging over equal parts of its length."""
    planes = np.moveaxis(planes, axis, 0)
    ends = np.linspace(0, len(planes), count + 1)
    whole = np.minimum(ends.astype(int), len(planes) - 1)
    share = (ends - whole).reshape(-1, *[1] * (planes.ndim - 1))
    before = np.cumsum(planes, 0, np.float64)[whole] - planes[whole]
    means = np.diff(before + share * planes[whole], axis=0) * (count / len(planes))
    return np.moveaxis(np.float32(means), 0, axis)
