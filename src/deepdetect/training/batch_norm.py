"""Batch normalisation in training: over the batches of all processes, or frozen."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn


class _SumOverProcesses(torch.autograd.Function):
    """The sum of a tensor over the processes; its gradient is the sum of theirs."""

    @staticmethod
    def forward(context: Any, x: Tensor) -> Tensor:
        total = x.clone()
        torch.distributed.all_reduce(total)
        return total

    @staticmethod
    def backward(context: Any, gradient: Tensor) -> Tensor:
        total = gradient.clone(memory_format=torch.contiguous_format)
        torch.distributed.all_reduce(total)
        return total


class SynchronizedBatchNorm(nn.BatchNorm2d):
    """Batch normalisation whose statistics are those of all processes' batches together.

    For CPUs (gloo): torch's own `SyncBatchNorm` runs on CUDA only. Every process must
    have as many pixels as the others.
    """

    def forward(self, x: Tensor) -> Tensor:
        if not self.training:
            return super().forward(x)
        values = x.float()  # sums in bfloat16 would lose too much
        processes = torch.distributed.get_world_size()
        count = values.numel() // values.shape[1] * processes
        mean = _SumOverProcesses.apply(values.mean((0, 2, 3))) / processes
        centred = values - mean[:, None, None]
        variance = _SumOverProcesses.apply(centred.square().mean((0, 2, 3))) / processes
        with torch.no_grad():
            self.running_mean.lerp_(mean, self.momentum)
            self.running_var.lerp_(variance * (count / (count - 1)), self.momentum)
            self.num_batches_tracked.add_(1)
        scale = self.weight * torch.rsqrt(variance + self.eps)
        return (centred * scale[:, None, None] + self.bias[:, None, None]).to(x.dtype)


def synchronize_batch_norm(network: nn.Module, device: torch.device) -> None:
    """Make all batch normalisations of a network take the statistics of all processes.

    The network is changed in place; names and values of its state stay.
    """
    if device.type == "cuda":
        nn.SyncBatchNorm.convert_sync_batchnorm(network)
        return
    for module in network.modules():
        if type(module) is nn.BatchNorm2d:
            module.__class__ = SynchronizedBatchNorm


def freeze_batch_norm(network: nn.Module) -> None:
    """Make the batch normalisations of a network that trains use the statistics they have.

    To be called after every `network.train()`, which thaws them. Their scales and biases
    are trained on.
    """
    for module in network.modules():
        if isinstance(module, nn.modules.batchnorm._BatchNorm):
            module.eval()
