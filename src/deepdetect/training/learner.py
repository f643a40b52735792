"""The network and its optimiser: one step at a time."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import nn
from torch.nn.functional import binary_cross_entropy_with_logits

from ..errors import OptionError
from .device import DeviceOptions, Engine


class Learner:
    """A network on its device, with Adam.

    Args:
        network: the network, with its start weights.
        device: how it is run.
    """

    def __init__(self, network: nn.Module, device: DeviceOptions) -> None:
        self.engine = Engine(network, device)
        self.network = self.engine.network
        self.optimizer = torch.optim.Adam(self.network.parameters(), fused=True)

    def learn(self, rgb: np.ndarray, masks: np.ndarray, rate: float, step: int) -> float:
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
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        images = self.engine.images(rgb)
        truth = self.engine.place_tensor(masks)[:, None].float()
        self.optimizer.zero_grad(set_to_none=True)
        loss = binary_cross_entropy_with_logits(self.engine.logits(images), truth)
        self.engine.backward(loss)
        gradients = [p.grad for p in self.network.parameters() if p.grad is not None]
        value = self.engine.mean_over_processes(loss.detach()).item()
        # A finite loss can have gradients that are not, in bfloat16.
        if not (math.isfinite(value) and torch.nn.utils.get_total_norm(gradients).isfinite()):
            raise OptionError(
                f"the loss or its gradients are not finite at step {step}: start again with "
                "--precision float32, or with a lower --learning-rate"
            )
        self.optimizer.step()
        return value
