"""Running the network for training: device, precision, compilation, one process or many.

Lightning Fabric places the network, wraps it for several processes (DistributedDataParallel)
and sets the precision; `torchrun` starts the processes.
"""

from __future__ import annotations

import datetime
import itertools
import logging
import os
import shutil
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import Tensor, nn

from .._shared.errors import OptionError
from .._shared.memory import disable_malloc_trim
from .recipe import DeviceOptions

if TYPE_CHECKING:
    from lightning_fabric import Fabric

BARRIER_TIMEOUT = datetime.timedelta(hours=24)
Value = TypeVar("Value")
_barriers = itertools.count()  # each has its own name in the store


@dataclass(frozen=True)
class DistributedContext:
    """This process among those of a run: `torchrun`'s RANK, WORLD_SIZE and so on."""

    rank: int = 0
    world_size: int = 1
    local_rank: int = 0
    local_world_size: int = 1

    def __post_init__(self) -> None:
        if self.world_size % self.local_world_size:
            raise OptionError(
                "there must be as many processes on each machine: "
                "give torchrun the same --nproc-per-node everywhere"
            )

    @classmethod
    def from_environment(cls) -> DistributedContext:
        """Read what `torchrun` sets in the environment; without it this is the only process.

        Raises:
            OptionError: the machines have different numbers of processes.

        Example:
            >>> DistributedContext.from_environment().world_size >= 1
            True
        """
        if "TORCHELASTIC_RUN_ID" not in os.environ:
            return cls()
        names = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")
        return cls(*(int(os.environ[name]) for name in names))

    @property
    def is_main(self) -> bool:
        """Whether this process writes the files and shows the progress."""
        return self.rank == 0

    @property
    def machines(self) -> int:
        """The number of machines."""
        return self.world_size // self.local_world_size

    def local_slice(self, count: int) -> slice:
        """Return this process's part of a batch; all parts have the same size.

        Raises:
            OptionError: the batch cannot be divided evenly.

        Example:
            >>> DistributedContext(1, 2, 1, 2).local_slice(8)
            slice(4, 8, None)
        """
        if count % self.world_size:
            raise OptionError(
                f"a batch of {count} cannot be divided evenly among {self.world_size} processes: "
                "choose `stages` whose batches are multiples of that number"
            )
        part = count // self.world_size
        return slice(self.rank * part, (self.rank + 1) * part)

    def barrier(self) -> None:
        """Wait, for hours if need be, until every process has come here equally often.

        Through torchrun's own store: the time limits of the training itself stay short, so that a
        dead process is noticed.
        """
        if self.world_size == 1:
            return
        from torch.distributed import PrefixStore, rendezvous  # type: ignore[attr-defined]

        store, _, _ = next(iter(rendezvous("env://", self.rank, self.world_size)))
        restart = os.environ.get("TORCHELASTIC_RESTART_COUNT", "0")
        barrier = PrefixStore(f"deepdetect-{restart}-{next(_barriers)}", store)
        barrier.set(str(self.rank), "here")
        barrier.wait([str(rank) for rank in range(self.world_size)], BARRIER_TIMEOUT)


class Engine:
    """A network on its device, with processes, precision and compilation as chosen.

    The network is moved, and stays the same object (with the same state).
    """

    def __init__(self, network: nn.Module, options: DeviceOptions) -> None:
        self.context = DistributedContext.from_environment()
        kind = options.accelerator
        if kind == "cpu":
            disable_malloc_trim()
        self.bfloat16 = options.precision == "bfloat16" or (
            options.precision == "auto" and _computes_bfloat16(kind)
        )
        self.fabric = _fabric(kind, self.context)
        self.fabric.launch()
        if options.threads is not None:
            torch.set_num_threads(options.threads)  # launching sets its own
        self.device = self.fabric.device
        # channels_last is faster by 40 % on CPUs, and what tensor cores want.
        self.network = network.to(self.device)
        self.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        if self.context.world_size > 1:
            synchronize_batch_norm(self.network, self.device)
        has_compiler = kind == "cuda" or any(map(shutil.which, ("g++", "clang++")))
        # Sums over processes, inside the batch normalisation, break the graph.
        default = has_compiler and self.context.world_size == 1
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
                reason = str(error).strip().splitlines()[0]
                raise OptionError(
                    f"torch.compile does not work here ({reason}): set `compile=False`"
                ) from None
            self.compiled = False
            self._forward = self._set_up()
            return self.logits(images)

    def all_reduce_mean(self, value: Tensor) -> Tensor:
        """Average a tensor over all processes."""
        if self.context.world_size == 1:
            return value
        return _all_reduce_sum(value) / self.context.world_size

    def all_gather(self, value: Value) -> list[Value]:
        """Return every process's value, in the order of the processes, to all of them."""
        if self.context.world_size == 1:
            return [value]
        gathered: list[Any] = [None] * self.context.world_size
        torch.distributed.all_gather_object(gathered, value)
        return gathered

    def broadcast_(self, tensor: Tensor) -> None:
        """Replace a tensor, in place, by that of the main process."""
        if self.context.world_size > 1:
            torch.distributed.broadcast(tensor, 0)

    def close(self) -> None:
        """Leave the process group, at the end of a run that went well."""
        # Not gloo's: its threads need the interpreter to let go of the last sum, and destroying
        # joins them without letting them have it (pytorch#190489). They end with the process.
        if self.context.world_size > 1 and self.device.type == "cuda":
            torch.distributed.destroy_process_group()

    def describe(self) -> str:
        """Say in words how the network is run."""
        precision = "bfloat16" if self.bfloat16 else "float32"
        words = [self.device.type, precision, "compiled" if self.compiled else "eager"]
        if self.context.world_size > 1:
            machines = f"{self.context.machines} machine(s)"
            words.append(f"{self.context.world_size} processes on {machines}")
        return ", ".join(words)


class SynchronizedBatchNorm(nn.BatchNorm2d):
    """`SyncBatchNorm` for CPUs, where torch's own does not run.

    Every process must have the same number of pixels.
    """

    def forward(self, x: Tensor) -> Tensor:
        if not self.training:
            return super().forward(x)
        running_mean, running_var = self.get_buffer("running_mean"), self.get_buffer("running_var")
        momentum = self.momentum or 0.0
        values = x.float()  # sums in bfloat16 would lose too much
        world_size = torch.distributed.get_world_size()
        count = values.numel() // values.shape[1] * world_size
        mean = _all_reduce_sum(values.mean((0, 2, 3))) / world_size
        centred = values - mean[:, None, None]
        variance = _all_reduce_sum(centred.square().mean((0, 2, 3))) / world_size
        with torch.no_grad():
            running_mean.lerp_(mean, momentum)
            running_var.lerp_(variance * (count / (count - 1)), momentum)
            self.get_buffer("num_batches_tracked").add_(1)
        scale = self.weight * torch.rsqrt(variance + self.eps)
        return (centred * scale[:, None, None] + self.bias[:, None, None]).to(x.dtype)


class _AllReduceSum(torch.autograd.Function):
    """The sum of a tensor over the processes; its gradient is the sum of theirs."""

    @staticmethod
    def forward(context: Any, x: Tensor) -> Tensor:
        total = x.clone(memory_format=torch.contiguous_format)
        torch.distributed.all_reduce(total)
        return total

    @staticmethod
    def backward(context: Any, *gradients: Tensor) -> Tensor:
        return _all_reduce_sum(gradients[0])


def _all_reduce_sum(x: Tensor) -> Tensor:
    return _AllReduceSum.apply(x)  # type: ignore[no-untyped-call]


def synchronize_batch_norm(network: nn.Module, device: torch.device) -> None:
    """Change a network in place: batch normalisations use the statistics of all processes."""
    if device.type == "cuda":
        nn.SyncBatchNorm.convert_sync_batchnorm(network)
        return
    for module in network.modules():
        if type(module) is nn.BatchNorm2d:
            module.__class__ = SynchronizedBatchNorm


def freeze_batch_norm(network: nn.Module) -> None:
    """Make the batch normalisations use the statistics they have, until `network.train()`."""
    for module in network.modules():
        if isinstance(module, nn.modules.batchnorm._BatchNorm):
            module.eval()


def _fabric(kind: str, context: DistributedContext) -> Fabric:
    from lightning_fabric import Fabric
    from lightning_fabric.plugins.environments.lightning import LightningEnvironment
    from lightning_fabric.plugins.environments.torchelastic import TorchElasticEnvironment
    from lightning_fabric.strategies.ddp import DDPStrategy

    if kind == "cuda" and context.local_world_size > torch.cuda.device_count():
        raise OptionError(
            f"{context.local_world_size} processes on this machine need as many GPUs, "
            f"but there are {torch.cuda.device_count()}: lower torchrun's --nproc-per-node"
        )
    logging.getLogger("lightning_fabric").setLevel(logging.WARNING)
    alone = context.world_size == 1
    return Fabric(
        accelerator=kind,
        devices=context.local_world_size,
        num_nodes=context.machines,
        # Buffers are the same everywhere: the batch normalisation sees to it.
        strategy="auto" if alone else DDPStrategy(broadcast_buffers=False),
        # Named, so that a batch system's variables in the environment change nothing.
        plugins=[LightningEnvironment() if alone else TorchElasticEnvironment()],
    )


def _computes_bfloat16(kind: str) -> bool:
    if kind == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    capabilities = getattr(torch.cpu, "_is_avx512_bf16_supported", None)
    return bool(capabilities and capabilities())
