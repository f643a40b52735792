"""Running a network for training: device, precision, compilation, one process or several GPUs.

Lightning Fabric wraps it for several GPUs, whose processes `torchrun` starts.
"""

from __future__ import annotations

import datetime
import logging
import os
import shutil
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from .._shared.errors import OptionError, first_line
from .._shared.machine import disable_malloc_trim
from .recipe import DeviceOptions

if TYPE_CHECKING:
    from lightning_fabric import Fabric

LABELS_TIMEOUT = datetime.timedelta(hours=24)
"""While the first process makes the labels, the others wait."""


def launch(options: DeviceOptions) -> Fabric:
    """Join the processes that `torchrun` has started, or be the only one."""
    from lightning_fabric import Fabric
    from lightning_fabric.plugins.environments.lightning import LightningEnvironment
    from lightning_fabric.plugins.environments.torchelastic import TorchElasticEnvironment
    from lightning_fabric.strategies.ddp import DDPStrategy

    if options.accelerator == "cpu":
        disable_malloc_trim()
    alone = "TORCHELASTIC_RUN_ID" not in os.environ
    local, world = (1 if alone else int(os.environ[f"{n}WORLD_SIZE"]) for n in ("LOCAL_", ""))
    if options.accelerator == "cuda" and local > torch.cuda.device_count():
        raise OptionError(
            f"there are {torch.cuda.device_count()} CUDA devices on this machine for {local} "
            "processes: use `device=cpu`, or lower torchrun's --nproc-per-node"
        )
    logging.getLogger("lightning_fabric").setLevel(logging.WARNING)
    fabric = Fabric(
        accelerator=options.accelerator,
        devices=local,
        num_nodes=world // local,
        # Buffers are the same everywhere: the batch normalisation sees to it.
        strategy="auto" if alone else DDPStrategy(broadcast_buffers=False, timeout=LABELS_TIMEOUT),
        # Named, so that a batch system's variables in the environment change nothing.
        plugins=[LightningEnvironment() if alone else TorchElasticEnvironment()],
    )
    fabric.launch()
    if options.threads is not None:
        torch.set_num_threads(options.threads)  # launching sets its own
    return fabric


class Engine:
    """A network, the same object, moved to its device, with precision and compilation as chosen."""

    def __init__(self, network: nn.Module, options: DeviceOptions, fabric: Fabric) -> None:
        kind = options.accelerator
        self.bfloat16 = options.precision == "bfloat16" or (
            options.precision == "auto" and _computes_bfloat16(kind)
        )
        self.fabric, self.device = fabric, fabric.device
        # channels_last is faster by 40 % on CPUs, and what tensor cores want.
        self.network = network.to(self.device)
        self.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        if fabric.world_size > 1 and kind == "cuda":
            nn.SyncBatchNorm.convert_sync_batchnorm(self.network)
        has_compiler = kind == "cuda" or any(map(shutil.which, ("g++", "clang++")))
        # Sums over processes, inside the batch normalisation, break the graph.
        default = has_compiler and fabric.world_size == 1
        self.compiled = default if options.compile is None else options.compile
        self._may_fall_back = options.compile is None
        self._forward = self._set_up()

    def _set_up(self) -> nn.Module:
        network: Any = self.network
        if self.compiled:
            # Not dynamic: there are only as many shapes as stages, and each gets its own code.
            network = torch.compile(network, dynamic=False)
        return self.fabric.setup_module(network, move_to_device=False)

    def to_device(self, values: Tensor) -> Tensor:
        """Copy a tensor to the device, without waiting where it is pinned."""
        return values.to(self.device, non_blocking=True)

    def to_float(self, images: Tensor) -> Tensor:
        """Turn (B, H, W, 3) uint8 into (B, 3, H, W) float32 in [0, 1] on the device."""
        return self.to_device(images).permute(0, 3, 1, 2).float().div_(255)

    def logits(self, images: Tensor) -> Tensor:
        """Run the network for training; logits are float32."""
        try:
            # Not Fabric's own precision, which would round the images to bfloat16 as well.
            with torch.autocast(self.device.type, torch.bfloat16, enabled=self.bfloat16):
                return self._forward(images).float()
        except torch._dynamo.exc.TorchDynamoException as error:
            # A compiler on the path may still lack headers, and CUDA its Triton.
            if not self._may_fall_back:
                raise OptionError(
                    f"torch.compile does not work here ({first_line(error)}): set `compile=False`"
                ) from None
            self.compiled = False
            self._forward = self._set_up()
            return self.logits(images)

    def describe(self) -> str:
        """Say in words how the network is run."""
        precision = "bfloat16" if self.bfloat16 else "float32"
        words = [self.device.type, precision, "compiled" if self.compiled else "eager"]
        if self.fabric.world_size > 1:
            words.append(f"{self.fabric.world_size} processes")
        return ", ".join(words)


def freeze_batch_norm(network: nn.Module) -> None:
    """Make the batch normalisations use the statistics they have, until `network.train()`."""
    for module in network.modules():
        if isinstance(module, nn.modules.batchnorm._BatchNorm):
            module.eval()


def _computes_bfloat16(kind: str) -> bool:
    if kind == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    capabilities = getattr(torch.cpu, "_is_avx512_bf16_supported", None)
    return bool(capabilities and capabilities())
