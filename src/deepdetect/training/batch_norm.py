"""Batch normalisation over the batches of all processes."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class SynchronizedBatchNorm(nn.BatchNorm2d):
    """Batch normalisation whose statistics are those of all processes' batches together.

    For CPUs (gloo): torch's own `SyncBatchNorm` runs on CUDA only. Every process must
    have as many pixels as the others.
    """

    def forward(self, x: Tensor) -> Tensor:
        if not self.training:
            return super().forward(x)
        x = x.float()  # sums in bfloat16 would lose too much
        count = x.numel() // x.shape[1] * torch.distributed.get_world_size()
        mean = _mean_over_processes(x.mean((0, 2, 3)))
        centred = x - mean[:, None, None]
        variance = _mean_over_processes(centred.square().mean((0, 2, 3)))
        with torch.no_grad():
            self.running_mean.lerp_(mean, self.momentum)
            self.running_var.lerp_(variance * (count / (count - 1)), self.momentum)
            self.num_batches_tracked.add_(1)
        scale = self.weight * torch.rsqrt(variance + self.eps)
        return centred * scale[:, None, None] + self.bias[:, None, None]


def _mean_over_processes(x: Tensor) -> Tensor:
    """Average a tensor over the processes; gradients flow back to all of them."""
    from torch.distributed.nn.functional import all_reduce

    return all_reduce(x) / torch.distributed.get_world_size()


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
