"""The fastest correct way to run the network for training, on one machine or on many.

Lightning Fabric places the network, wraps it for several processes (DistributedDataParallel)
and sets the precision; `torchrun` starts the processes.
"""

from __future__ import annotations

import contextlib
import logging
import shutil
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from torch import nn

from .._shared.errors import OptionError, unknown_name
from .._shared.parallel import disable_malloc_trim, processor_count
from .batch_norm import synchronize_batch_norm
from .cluster import DistributedContext, distributed_context

if TYPE_CHECKING:
    from lightning_fabric import Fabric

PRECISIONS = ("auto", "float32", "bfloat16")


@dataclass(frozen=True)
class DeviceOptions:
    """How the network is run; the recipe stays the same.

    Attributes:
        device: "auto" (CUDA when there is one, else the CPU), "cpu" or "cuda".
        precision: "bfloat16" runs in bfloat16; "auto" takes it where the processor
            computes with it.
        compile: torch.compile; None means when a C++ compiler is at hand.
        threads: CPU threads of torch; None leaves torch's choice.
        num_workers: threads that make batches; None means one beside a CPU that trains, and
            all but one of the processors beside a GPU.
    """

    device: Literal["auto", "cpu", "cuda"] = "auto"
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    compile: bool | None = None
    threads: int | None = None
    num_workers: int | None = None

    def __post_init__(self) -> None:
        if self.device not in ("auto", "cpu", "cuda"):
            raise unknown_name("device", self.device, ("auto", "cpu", "cuda"))
        if self.precision not in PRECISIONS:
            raise unknown_name("precision", self.precision, PRECISIONS)
        if self.device == "cuda" and not torch.cuda.is_available():
            raise OptionError("there is no CUDA device: use --device cpu")
        for name in ("threads", "num_workers"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise OptionError(f"{name} must be at least 1, not {value}")


class Engine:
    """A network placed on its device, with processes, precision and compilation as chosen.

    Args:
        network: the network; it is moved and keeps its own identity (for its state).
        options: the choices.
    """

    def __init__(self, network: nn.Module, options: DeviceOptions) -> None:
        self.place = distributed_context()
        kind = options.device
        if kind == "auto":
            kind = "cuda" if torch.cuda.is_available() else "cpu"
        if kind == "cpu":
            disable_malloc_trim()
        self.bfloat16 = options.precision == "bfloat16" or (
            options.precision == "auto" and _computes_bfloat16(kind)
        )
        self.fabric = _fabric(kind, self.place)
        self.fabric.launch()
        if options.threads is not None:
            torch.set_num_threads(options.threads)  # launching sets its own
        self.device = self.fabric.device
        # channels_last is faster by 40 % on CPUs, and what tensor cores want.
        self.network = network.to(self.device, memory_format=torch.channels_last)
        if self.place.processes > 1:
            synchronize_batch_norm(self.network, self.device)
        compiled = options.compile
        if compiled is None:
            has_compiler = kind == "cuda" or any(map(shutil.which, ("g++", "clang++")))
            # Sums over processes, inside the batch normalisation, break the graph.
            compiled = has_compiler and self.place.processes == 1
        self.compiled = bool(compiled)
        self.num_workers = options.num_workers or _loaders(kind, self.place)
        self._may_fall_back = options.compile is None
        self._forward = self._set_up()

    def _set_up(self) -> nn.Module:
        network = self.network
        if self.compiled:
            # Not dynamic: there are only as many shapes as stages, and each gets its own code.
            network = torch.compile(network, dynamic=False)
        return self.fabric.setup_module(network, move_to_device=False)

    def images(self, rgb: np.ndarray | torch.Tensor) -> torch.Tensor:
        """Turn (B, H, W, 3) uint8 into (B, 3, H, W) float32 in [0, 1], channels last."""
        return self.to_device(rgb).permute(0, 3, 1, 2).float().div_(255)

    def to_device(self, values: np.ndarray | torch.Tensor) -> torch.Tensor:
        """Bring values onto the device."""
        tensor = torch.as_tensor(values)
        if self.device.type == "cuda":
            return tensor.pin_memory().to(self.device, non_blocking=True)
        return tensor

    def autocast(self) -> contextlib.AbstractContextManager:
        """Return the context that the forward pass of training runs in.

        Not Fabric's own precision, which would round the images to bfloat16 as well.
        """
        if not self.bfloat16:
            return contextlib.nullcontext()
        return torch.autocast(self.device.type, dtype=torch.bfloat16)

    def logits(self, images: torch.Tensor) -> torch.Tensor:
        """Run the network for training; logits are float32."""
        try:
            with self.autocast():
                return self._forward(images).float()
        except torch._dynamo.exc.TorchDynamoException as error:
            # A compiler on the path may still lack headers, and CUDA its Triton.
            if not self._may_fall_back:
                reason = str(error).strip().splitlines()[0]
                raise OptionError(
                    f"torch.compile does not work here ({reason}): use --no-compile"
                ) from None
            self.compiled = False
            self._forward = self._set_up()
            return self.logits(images)

    def backward(self, loss: torch.Tensor) -> None:
        """Take the gradients, averaged over all processes."""
        self.fabric.backward(loss)

    def mean_over_processes(self, value: torch.Tensor) -> torch.Tensor:
        """Average a tensor over all processes."""
        if self.place.processes == 1:
            return value
        total = value.clone()
        torch.distributed.all_reduce(total)
        return total / self.place.processes

    def gather(self, values: Any) -> list[Any]:
        """Return every process's values, in the order of the processes, to all of them."""
        if self.place.processes == 1:
            return [values]
        gathered: list[Any] = [None] * self.place.processes
        torch.distributed.all_gather_object(gathered, values)
        return gathered

    def broadcast(self, values: Any) -> Any:
        """Return the first process's values to all."""
        return self.fabric.broadcast(values)

    def share(self, tensor: torch.Tensor) -> None:
        """Bring the first process's tensor to all, in place."""
        if self.place.processes > 1:
            torch.distributed.broadcast(tensor, 0)

    def close(self) -> None:
        """Part from the other processes, at the end of a run that went well.

        After an error nobody can be waited for: the process ends, and torchrun the others.
        """
        # Not gloo's: its threads need the interpreter to let go of the last sum, and destroying
        # joins them without letting them have it (pytorch#190489). They end with the process.
        if self.place.processes > 1 and self.device.type == "cuda":
            torch.distributed.destroy_process_group()

    def describe(self) -> str:
        """Say in words how the network is run."""
        precision = "bfloat16" if self.bfloat16 else "float32"
        words = [self.device.type, precision, "compiled" if self.compiled else "eager"]
        if self.place.processes > 1:
            words.append(f"{self.place.processes} processes on {self.place.machines} machine(s)")
        return ", ".join(words)


def _fabric(kind: str, place: DistributedContext) -> Fabric:
    from lightning_fabric import Fabric
    from lightning_fabric.plugins.environments import LightningEnvironment, TorchElasticEnvironment
    from lightning_fabric.strategies import DDPStrategy

    if kind == "cuda" and place.local_processes > torch.cuda.device_count():
        raise OptionError(
            f"{place.local_processes} processes on this machine need as many GPUs, "
            f"there are {torch.cuda.device_count()}: lower --nproc-per-node"
        )
    logging.getLogger("lightning_fabric").setLevel(logging.WARNING)
    alone = place.processes == 1
    return Fabric(
        accelerator=kind,
        devices=place.local_processes,
        num_nodes=place.machines,
        # Buffers are the same everywhere: the batch normalisation sees to it.
        strategy="auto" if alone else DDPStrategy(broadcast_buffers=False),
        # Named, so that a batch system's variables in the environment change nothing.
        plugins=[LightningEnvironment() if alone else TorchElasticEnvironment()],
    )


def _loaders(kind: str, place: DistributedContext) -> int:
    """Return how many threads make batches: a CPU that trains has none to spare."""
    if kind == "cpu":
        return 1
    return max(1, processor_count() // place.local_processes - 1)


def _computes_bfloat16(kind: str) -> bool:
    if kind == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    capabilities = getattr(torch.cpu, "_is_avx512_bf16_supported", None)
    return bool(capabilities and capabilities())
