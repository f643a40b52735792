"""Training of the detector network on labelled crops, with a cross-entropy for each pixel."""

from __future__ import annotations

import copy
import dataclasses
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, pad
from torch.utils.data import DataLoader

from deepdetect._shared.errors import OptionError, first_line
from deepdetect._shared.machine import disable_malloc_trim
from deepdetect._shared.options import look_up
from deepdetect.io.image import luma

from ..evaluation.masks import score_heatmap
from ..labels import visibility_of
from ..networks.export import export_onnx
from ..networks.weights import (
    NETWORKS,
    average_weights,
    find_weights,
    load_network,
    weights_digest,
)
from .dataset import CropDataset, TrainingData, ValidationDataset, loading
from .optim import make_optimizers
from .recipe import DeviceOptions, InitWeights, TrainingOptions
from .sampler import Schedule, milestones
from .trainer import Trainer, seeded

ONNX = "deepdetect.onnx"
COMPILING = (
    "the first step of each stage compiles the network, which takes minutes on two cores; with "
    "--no-compile, training starts at once, but each step takes longer"
)


def initial_network(
    options: TrainingOptions, init_weights: InitWeights | None
) -> tuple[TrainingOptions, nn.Module]:
    """Return the completed options, and the network with its initial weights.

    If `frozen_batch_norm` is None, it becomes true with trained initial weights, else false.
    """
    make = look_up("network", options.network, NETWORKS)
    if init_weights is not None:
        if options.frozen_batch_norm is None:
            options = dataclasses.replace(options, frozen_batch_norm=True)
        chosen = [init_weights] if isinstance(init_weights, (str, Path)) else list(init_weights)
        paths = [find_weights(name) for name in chosen]
        network = average_weights(paths)
        if type(network) is not make:
            raise OptionError(
                f"the initial weights do not belong to the network {options.network}: give other "
                "`init_weights`, or another `network`"
            )
        return options, network
    if options.frozen_batch_norm:
        raise OptionError(
            "`frozen_batch_norm` keeps the batch statistics of the initial weights, and those of "
            "random weights are useless: give trained `init_weights`, or leave the option out"
        )
    return dataclasses.replace(options, frozen_batch_norm=False), seeded(make, options.seed)


class DenseTrainer(Trainer):
    """Training of a network that maps images to heat maps of keypoints, on labelled images."""

    objective, sign = "validation_loss", 1
    purpose = (
        "that maps an RGB image, with values in [0, 1], to the probability of each pixel to be "
        "marked by a label detector"
    )
    measures = (
        "On the validation images, in normal light and darkened: the mean binary cross-entropy "
        "per pixel, and the intersection over union of the label and the pixels with a "
        "probability above 0.5"
    )
    weights_file = "best.safetensors"

    def __init__(
        self,
        network: nn.Module,
        options: TrainingOptions,
        data: TrainingData,
        device: DeviceOptions,
    ) -> None:
        self.options, self.data, self.device_options = options, data, device
        kind = device.accelerator
        self.device = torch.device(kind)
        if kind == "cpu":
            disable_malloc_trim()
        if device.threads is not None:
            torch.set_num_threads(device.threads)
        initial_weights = weights_digest(network)
        self.bfloat16 = device.precision == "bfloat16" or (
            device.precision == "auto" and _computes_bfloat16(kind)
        )
        # The memory format channels_last is 40 % faster on CPUs, and suits tensor cores.
        self.network = network.to(self.device)
        self.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = copy.deepcopy(self.network).eval()
        self.average_decay = options.average_decay
        self.max_gradient_norm = options.max_gradient_norm or math.inf
        has_compiler = kind == "cuda" or any(map(shutil.which, ("g++", "clang++")))
        self.compiled = has_compiler if device.compile is None else device.compile
        self._forward = self._set_up()
        self.optimizers = make_optimizers(options.optimizer, network)
        self.schedule = Schedule(options, len(data.training))
        self.steps = self.schedule.steps
        self.milestones = milestones(self.steps, options.val_count)
        self.origin = {"images_digest": data.digest, "initial_weights": initial_weights}
        how = self.describe()
        self.notes = {"images": str(len(data.training)), "run_on": how}
        self.introduction = [f"training on {how}", *([COMPILING] if self.compiled else [])]

    def _set_up(self) -> nn.Module:
        if not self.compiled:
            return self.network
        # Each stage has one input shape, for which torch compiles separate code.
        return torch.compile(self.network, dynamic=False)  # type: ignore[return-value]

    def to_device(self, values: Tensor) -> Tensor:
        """Copy a tensor to the device, asynchronously if its memory is pinned."""
        return values.to(self.device, non_blocking=True)

    def to_float(self, images: Tensor) -> Tensor:
        """Convert (B, H, W, 3) uint8 to (B, 3, H, W) float32 in [0, 1] on the device."""
        return self.to_device(images).permute(0, 3, 1, 2).float().div_(255)

    def logits(self, images: Tensor) -> Tensor:
        """Run `network` on (B, 3, H, W) float32 images; return float32 logits (B, 1, H, W)."""
        try:
            with torch.autocast(self.device.type, torch.bfloat16, enabled=self.bfloat16):
                return self._forward(images).float()
        except torch._dynamo.exc.TorchDynamoException as error:
            # Compilation may still fail without compiler headers, or on CUDA without Triton.
            if self.device_options.compile:
                raise OptionError(
                    f"torch.compile does not work here ({first_line(error)}): set `compile=False`"
                ) from None
            self.compiled = False
            self._forward = self._set_up()
            return self.logits(images)

    def describe(self) -> str:
        """Describe, for the log, the device, the precision and whether the network is compiled."""
        precision = "bfloat16" if self.bfloat16 else "float32"
        return f"{self.device.type}, {precision}, {'compiled' if self.compiled else 'eager'}"

    def loader(self, first: int = 0) -> DataLoader[Any]:
        """Return a loader of the batches (images, labels) from step `first` on."""
        dataset = CropDataset(self.data.training, self.options)
        return self._loader(dataset, batch_sampler=self.schedule.batches(first))

    def _loader(self, dataset: Any, **batches: Any) -> DataLoader[Any]:
        return DataLoader(
            dataset,
            num_workers=self.device_options.worker_count,
            pin_memory=self.device.type == "cuda",
            # torch's default generator would change the user's random state.
            generator=torch.Generator(),
            **batches,
        )

    def learning_rate(self, step: int) -> float:
        return self.schedule.learning_rate(step)

    def loss(self, batch: tuple[Tensor, Tensor]) -> Tensor:
        """Return the loss of images (B, crop, crop, 3) uint8 with labels (B, crop, crop) bool."""
        images, masks = batch
        self.network.train()
        if self.options.frozen_batch_norm:
            freeze_batch_norm(self.network)
        truth = self.to_device(masks)[:, None].float()
        logits = self.logits(self.to_float(images))
        return binary_cross_entropy_with_logits(logits, truth, pos_weight=self._pos_weight(images))

    def _pos_weight(self, images: Tensor) -> Tensor | None:
        """Return the loss weight of marked pixels: (B, 1, 1, 1), or (1,) if equal, or None if 1."""
        normal, dark = self.options.pos_weight, self.options.low_light_pos_weight
        if dark is None or dark == normal:  # the weight does not depend on the visibility
            return None if normal == 1 else self.to_device(torch.tensor([normal]))
        weights = {"normal": normal, "low": dark}
        each = [weights[visibility_of(luma(image))] for image in images.numpy()]
        return self.to_device(torch.tensor(each)[:, None, None, None])

    def validate(self, step: int) -> dict[str, float]:
        """Return the losses and the intersections over union on the validation images."""
        dataset = ValidationDataset(self.data.validation)
        with loading(self._loader(dataset, batch_size=None)) as pairs:
            scores = [score_heatmap(self.heatmap(image), mask.numpy()) for image, mask in pairs]
        by_light = np.reshape(scores, (2, -1, 2)).mean(axis=1)
        (normal_loss, normal_iou), (dark_loss, dark_iou) = by_light.tolist()
        fraction, crops = self.options.dark_fraction, self.schedule.crops_until(step)
        return {
            "epoch": crops / self.schedule.images,
            "images": crops,
            "learning_rate": self.learning_rate(step - 1),
            "validation_loss": (1 - fraction) * normal_loss + fraction * dark_loss,
            "normal_loss": normal_loss,
            "normal_iou": normal_iou,
            "dark_loss": dark_loss,
            "dark_iou": dark_iou,
        }

    @torch.inference_mode()
    def heatmap(self, image: Tensor) -> np.ndarray:
        """Run the averaged network on an image, (H, W, 3) uint8; return probabilities (H, W)."""
        height, width = image.shape[:2]
        batch = self.to_float(image[None])
        batch = pad(batch, (0, -width % 8, 0, -height % 8), mode="replicate")
        batch = batch.contiguous(memory_format=torch.channels_last)
        logits = self.average(batch)[0, 0, :height, :width]
        return torch.sigmoid(logits.float()).cpu().numpy()

    def export(self, folder: Path) -> Path:
        best = load_network(folder / self.weights_file)
        export_onnx(best, folder / ONNX)
        return folder / ONNX


def freeze_batch_norm(network: nn.Module) -> None:
    """Normalise batches by the running statistics, until `network.train()` is called."""
    for module in network.modules():
        if isinstance(module, nn.modules.batchnorm._BatchNorm):
            module.eval()


def _computes_bfloat16(kind: str) -> bool:
    if kind == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    capabilities = getattr(torch.cpu, "_is_avx512_bf16_supported", None)
    return bool(capabilities and capabilities())
