"""The network and its optimisers: one step at a time."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import nn
from torch.nn.functional import binary_cross_entropy_with_logits

from .._shared.errors import OptionError
from ..io.image import luma
from ..labels import visibility_of
from .batch_norm import freeze_batch_norm
from .device import DeviceOptions, Engine
from .optimizers import make_optimizers


class Learner:
    """A network on its device, with what optimises it.

    Args:
        network: the network, with its start weights.
        device: how it is run.
        optimizer: name of the optimiser.
        frozen_batch_norm: keep the statistics of the batch normalisation as they are.
        pos_weight: weight of a marked pixel in the loss; others have 1.
        low_light_pos_weight: the same in images of low visibility; None: as in all others.
        pos_weight_uncertain: scale these weights by the uncertainty p(1 - p): they hold at a
            probability of one half and fall to 1 where the network is certain.
        freeze_encoder: keep the network's `encoder` as it is.
    """

    def __init__(
        self,
        network: nn.Module,
        device: DeviceOptions,
        optimizer: str = "adam",
        frozen_batch_norm: bool = False,
        pos_weight: float = 1.0,
        low_light_pos_weight: float | None = None,
        pos_weight_uncertain: bool = False,
        freeze_encoder: bool = False,
    ) -> None:
        self.frozen_batch_norm = frozen_batch_norm
        self.freeze_encoder = freeze_encoder
        if self.freeze_encoder:  # before it is compiled, which then leaves its gradients out
            network.encoder.requires_grad_(False)
        self.engine = Engine(network, device)
        self.network = self.engine.network
        self.optimizers = make_optimizers(optimizer, self.network, self.engine.share)
        dark = pos_weight if low_light_pos_weight is None else low_light_pos_weight
        self.pos_weights = {"normal": pos_weight, "low": dark}
        self.pos_weight_uncertain = pos_weight_uncertain

    def training_step(self, rgb: np.ndarray, masks: np.ndarray, rate: float, step: int) -> float:
        """Make one optimiser step.

        Args:
            rgb: (B, crop, crop, 3) uint8, this process's part of the batch.
            masks: (B, crop, crop) bool, its labels.
            rate: the learning rate.
            step: number of the step, for the error.

        Returns:
            The loss over the whole batch.

        Raises:
            OptionError: the loss or its gradients are not finite.
        """
        self.network.train()
        if self.frozen_batch_norm:
            freeze_batch_norm(self.network)
        elif self.freeze_encoder:
            freeze_batch_norm(self.network.encoder)
        for optimizer in self.optimizers:
            optimizer.zero_grad(set_to_none=True)
            for group in optimizer.param_groups:
                group["lr"] = rate
        images = self.engine.images(rgb)
        truth = self.engine.to_device(masks)[:, None].float()
        logits = self.engine.logits(images)
        weight = self._weight_of_marked(rgb)
        if self.pos_weight_uncertain and weight is not None:
            probability = logits.detach().sigmoid()
            weight = 1 + (weight - 1) * 4 * probability * (1 - probability)
        loss = binary_cross_entropy_with_logits(logits, truth, pos_weight=weight)
        self.engine.backward(loss)
        gradients = [p.grad for p in self.network.parameters() if p.grad is not None]
        value = self.engine.mean_over_processes(loss.detach()).item()
        # A finite loss can have gradients that are not, in bfloat16.
        if not (math.isfinite(value) and torch.nn.utils.get_total_norm(gradients).isfinite()):
            raise OptionError(
                f"the loss or its gradients are not finite at step {step}: start again with "
                "--precision float32, or with a lower --learning-rate"
            )
        for optimizer in self.optimizers:
            optimizer.step()
        return value

    def _weight_of_marked(self, rgb: np.ndarray) -> torch.Tensor | None:
        """Return the weights of the images' marked pixels, (B, 1, 1, 1) or (1,); None: all 1."""
        normal, dark = self.pos_weights["normal"], self.pos_weights["low"]
        if normal == dark == 1:
            return None
        if normal == dark:  # the images need not be looked at
            return self.engine.to_device(np.full(1, normal, np.float32))
        found = [self.pos_weights[visibility_of(luma(image))] for image in rgb]
        return self.engine.to_device(np.array(found, np.float32)[:, None, None, None])
