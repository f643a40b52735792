"""The training of the network: crops with labels, the loss of each pixel, the validation."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, pad
from torch.utils.data import DataLoader

from .._shared.errors import OptionError
from .._shared.options import look_up
from ..detector.network.espnet import ESPNet
from ..detector.network.onnx_export import export_onnx
from ..detector.network.weights import (
    average_weights,
    load_network,
    read_notes,
    save_weights,
    weights_digest,
)
from ..detector.pretrained import resolve_weights
from ..evaluation.metrics.masks import score_heatmap
from ..io.image import luma
from ..labels import visibility_of
from .checkpoint import Point
from .dataset import CropDataset, TrainingData, ValidationDataset, loading
from .engine import Engine, freeze_batch_norm
from .optim import make_optimizers
from .recipe import DeviceOptions, InitWeights, TrainingOptions
from .sampler import CropSampler, Schedule, milestones
from .trainer import Trainer

NETWORKS: dict[str, Callable[[], nn.Module]] = {"espnet": ESPNet}
"""What can be trained: from (B, 3, H, W) float32 RGB in [0, 1], sides multiples of 8, to logits."""

ONNX = "deepdetect.onnx"


def initial_network(
    options: TrainingOptions, init_weights: InitWeights | None
) -> tuple[TrainingOptions, nn.Module]:
    """Make the network with its initial weights, and resolve the options that depend on them."""
    make = look_up("network", options.network, NETWORKS)
    if init_weights is not None:
        if options.frozen_batch_norm is None:
            options = dataclasses.replace(options, frozen_batch_norm=True)
        chosen = [init_weights] if isinstance(init_weights, (str, Path)) else list(init_weights)
        paths = [resolve_weights(name, ".safetensors") for name in chosen]
        return options, average_weights(paths, make)
    for name, what in (("frozen_batch_norm", "batch statistics"), ("freeze_encoder", "encoder")):
        if getattr(options, name):
            raise OptionError(
                f"`{name}` would keep the {what} of random weights: "
                "give trained ones as `init_weights`, or leave it out"
            )
    with torch.random.fork_rng(devices=()):  # the caller's random numbers are left alone
        torch.default_generator.manual_seed(options.seed)
        return dataclasses.replace(options, frozen_batch_norm=False), make()


class DenseTrainer(Trainer):
    """A network that maps images to heat maps, with its initial weights, and labelled images."""

    objective, sign = "validation_loss", 1
    weights_file = "best.safetensors"

    def __init__(
        self,
        network: nn.Module,
        options: TrainingOptions,
        data: TrainingData,
        device: DeviceOptions,
        fabric: Any,
    ) -> None:
        self.options, self.data, self.device = options, data, device
        initial_weights = weights_digest(network)
        if options.freeze_encoder:  # before it is compiled, which then leaves its gradients out
            network.get_submodule("encoder").requires_grad_(False)
        self.engine = Engine(network, device, fabric)
        self.network, self.fabric, self.is_main = network, fabric, fabric.is_global_zero
        if fabric.world_size > 1 and device.accelerator == "cpu" and not options.frozen_batch_norm:
            raise OptionError(
                "several processes need GPUs, or `frozen_batch_norm`: batch normalisation over "
                "several CPUs is not there"
            )
        self.optimizers = make_optimizers(options.optimizer, network)
        self.schedule = Schedule(options, len(data.training))
        self.steps = self.schedule.steps
        self.milestones = milestones(self.steps, options.val_count)
        self.origin = {"images_digest": data.digest, "initial_weights": initial_weights}
        how = self.engine.describe()
        self.notes = {"images": str(len(data.training)), "run_on": how}
        self.introduction = [f"training on {how}"]
        if self.engine.compiled:
            self.introduction.append(
                "the first step of each stage compiles the network, which takes minutes on two "
                "cores; --no-compile starts at once, and each step takes longer"
            )

    def loader(self, first: int = 0, last: int | None = None) -> DataLoader[Any]:
        """Return the loader of the batches of some steps: (images, masks), see `CropDataset`."""
        rank, world = self.fabric.global_rank, self.fabric.world_size
        steps = self.schedule, self.data.shard_sizes, first, last
        sampler = CropSampler(*steps, rank=rank, world_size=world)
        return self._loader(CropDataset(self.data.training, self.options), batch_sampler=sampler)

    def _loader(self, dataset: Any, **batches: Any) -> DataLoader[Any]:
        return DataLoader(
            dataset,
            num_workers=self.device.worker_count,
            pin_memory=self.engine.device.type == "cuda",
            generator=torch.Generator(),  # not torch's own, whose state is the user's
            **batches,
        )

    def pixels(self, batch: tuple[Tensor, Tensor]) -> int:
        return batch[1].numel() * self.fabric.world_size

    def learning_rate(self, step: int) -> float:
        return self.schedule.learning_rate(step)

    def loss(self, batch: tuple[Tensor, Tensor]) -> Tensor:
        """Return the loss of (B, crop, crop, 3) uint8 RGB with (B, crop, crop) bool labels."""
        images, masks = batch
        self.network.train()
        if self.options.frozen_batch_norm:
            freeze_batch_norm(self.network)
        elif self.options.freeze_encoder:
            freeze_batch_norm(self.network.get_submodule("encoder"))
        truth = self.engine.to_device(masks)[:, None].float()
        logits = self.engine.logits(self.engine.to_float(images))
        weight = self._pos_weight(images)
        if self.options.pos_weight_uncertain and weight is not None:
            probability = logits.detach().sigmoid()
            weight = 1 + (weight - 1) * 4 * probability * (1 - probability)
        return binary_cross_entropy_with_logits(logits, truth, pos_weight=weight)

    def backward(self, loss: Tensor) -> float:
        self.fabric.backward(loss)
        return float(self.fabric.all_reduce(loss.detach(), reduce_op="mean").item())

    def _pos_weight(self, images: Tensor) -> Tensor | None:
        """Return the weights of the images' marked pixels, (B, 1, 1, 1) or (1,); None: all 1."""
        normal, dark = self.options.pos_weight, self.options.low_light_pos_weight
        if dark is None or dark == normal:  # the images need not be looked at
            return None if normal == 1 else self.engine.to_device(torch.tensor([normal]))
        weights = {"normal": normal, "low": dark}
        each = [weights[visibility_of(luma(image))] for image in images.numpy()]
        return self.engine.to_device(torch.tensor(each)[:, None, None, None])

    def validate(self, step: int) -> dict[str, float]:
        """Return the losses and the intersections over union on the validation images."""
        rank, world = self.fabric.global_rank, self.fabric.world_size
        dataset = ValidationDataset(self.data.validation, rank, world)
        sums = torch.zeros(2, 3, device=self.engine.device, dtype=torch.float64)
        self.network.eval()
        with loading(self._loader(dataset, batch_size=None)) as pairs:
            for number, (image, mask) in enumerate(pairs):
                loss, iou = score_heatmap(self.heatmap(image), mask.numpy())
                sums[int(number >= len(dataset) // 2)] += torch.tensor(
                    [loss, iou, 1.0], dtype=torch.float64
                )
        sums = self.fabric.all_reduce(sums, reduce_op="sum")
        (normal_loss, normal_iou), (dark_loss, dark_iou) = (sums[:, :2] / sums[:, 2:]).tolist()
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
        """Run the network, in evaluation mode, in float32 on (H, W, 3) uint8 of any size."""
        height, width = image.shape[:2]
        batch = self.engine.to_float(image[None])
        batch = pad(batch, (0, -width % 8, 0, -height % 8), mode="replicate")
        batch = batch.contiguous(memory_format=torch.channels_last)
        logits = self.network(batch)[0, 0, :height, :width]
        return torch.sigmoid(logits.float()).cpu().numpy()

    def save(self, path: Path, notes: Mapping[str, Any]) -> None:
        save_weights(self.network, path, dict(notes))

    def read_notes(self, path: Path) -> Mapping[str, Any]:
        return read_notes(path)

    def export(self, folder: Path) -> Path:
        best = load_network(folder / self.weights_file, NETWORKS[self.options.network])
        export_onnx(best, folder / ONNX)
        return folder / ONNX

    def card(self, best: Point) -> tuple[str, list[str]]:
        count = sum(parameter.numel() for parameter in self.network.parameters())
        network = (
            f"{type(self.network).__name__}, {count:,} parameters. Input: RGB in [0, 1]; output: "
            "the\nprobability that a pixel is a keypoint or an edge for one of the label detectors."
        )
        return network, [
            "On the validation images, by which these weights were chosen (mean binary",
            "cross-entropy per pixel / intersection over union at threshold 0.5):",
            "",
            f"- normal: {best['normal_loss']:.4f} / {best['normal_iou']:.3f}",
            f"- darkened: {best['dark_loss']:.4f} / {best['dark_iou']:.3f}",
        ]
