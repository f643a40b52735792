"""The network with its optimisers: a training step, and the validation."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, pad

from .._shared.errors import OptionError
from ..evaluation.metrics.masks import MaskScore, score_heatmap
from ..io.image import luma
from ..labels import visibility_of
from .engine import Engine, freeze_batch_norm
from .optim import make_optimizers
from .recipe import DeviceOptions, TrainingOptions


class Learner:
    """A network on its device, with what optimises it as a recipe says."""

    def __init__(self, network: nn.Module, device: DeviceOptions, options: TrainingOptions) -> None:
        self.options = options
        if options.freeze_encoder:  # before it is compiled, which then leaves its gradients out
            network.get_submodule("encoder").requires_grad_(False)
        self.engine = Engine(network, device)
        self.network = self.engine.network
        self.optimizers = make_optimizers(options.optimizer, self.network, self.engine.broadcast_)

    def training_step(
        self, images: Tensor, masks: Tensor, learning_rate: float, step: int
    ) -> float:
        """Make one optimiser step, and return the loss over the whole batch.

        Args:
            images: (B, crop, crop, 3) uint8 RGB, this process's part of the batch.
            masks: (B, crop, crop) bool, its labels.
            learning_rate: of this step.
            step: number of the step, for the error.

        Raises:
            OptionError: the loss or its gradients are not finite.
        """
        self.network.train()
        if self.options.frozen_batch_norm:
            freeze_batch_norm(self.network)
        elif self.options.freeze_encoder:
            freeze_batch_norm(self.network.get_submodule("encoder"))
        for optimizer in self.optimizers:
            optimizer.zero_grad(set_to_none=True)
            for group in optimizer.param_groups:
                group["lr"] = learning_rate
        truth = self.engine.to_device(masks)[:, None].float()
        logits = self.engine.logits(self.engine.to_float(images))
        weight = self._pos_weight(images)
        if self.options.pos_weight_uncertain and weight is not None:
            probability = logits.detach().sigmoid()
            weight = 1 + (weight - 1) * 4 * probability * (1 - probability)
        loss = binary_cross_entropy_with_logits(logits, truth, pos_weight=weight)
        self.engine.fabric.backward(loss)
        gradients = [p.grad for p in self.network.parameters() if p.grad is not None]
        value = self.engine.all_reduce_mean(loss.detach()).item()
        # A finite loss can have gradients that are not, in bfloat16.
        if not (math.isfinite(value) and torch.nn.utils.get_total_norm(gradients).isfinite()):
            raise OptionError(
                f"the loss or its gradients are not finite at step {step}: start again with "
                "`precision=float32`, or with a lower `learning_rate`"
            )
        for optimizer in self.optimizers:
            optimizer.step()
        return value

    def _pos_weight(self, images: Tensor) -> Tensor | None:
        """Return the weights of the images' marked pixels, (B, 1, 1, 1) or (1,); None: all 1."""
        normal, dark = self.options.pos_weight, self.options.low_light_pos_weight
        if dark is None or dark == normal:  # the images need not be looked at
            return None if normal == 1 else self.engine.to_device(torch.tensor([normal]))
        weights = {"normal": normal, "low": dark}
        found = [weights[visibility_of(luma(image))] for image in images.numpy()]
        return self.engine.to_device(torch.tensor(found)[:, None, None, None])

    def score(self, pairs: Iterable[tuple[Tensor, Tensor]]) -> list[MaskScore]:
        """Score the network on (H, W, 3) uint8 RGB images with (H, W) bool labels, in float32."""
        was_training = self.network.training
        self.network.eval()
        scores = [score_heatmap(self._heatmap(image), mask.numpy()) for image, mask in pairs]
        self.network.train(was_training)
        return scores

    @torch.inference_mode()
    def _heatmap(self, image: Tensor) -> np.ndarray:
        """Run the network on an image of any size."""
        height, width = image.shape[:2]
        batch = self.engine.to_float(image[None])
        batch = pad(batch, (0, -width % 8, 0, -height % 8), mode="replicate")
        batch = batch.contiguous(memory_format=torch.channels_last)
        logits = self.network(batch)[0, 0, :height, :width]
        return torch.sigmoid(logits.float()).cpu().numpy()
