"""The fastest correct way to run the network for training on this machine."""

from __future__ import annotations

import contextlib
import shutil
from dataclasses import dataclass
from typing import Literal

import torch
from torch import nn

from ..errors import OptionError, unknown_name

PRECISIONS = ("auto", "float32", "bfloat16")


@dataclass(frozen=True)
class DeviceOptions:
    """How the network is run; the recipe stays the same.

    Attributes:
        device: "auto" (CUDA when there is one, else the CPU), "cpu" or "cuda".
        precision: "bfloat16" runs in bfloat16, but on the CPU the dilated convolutions;
            "auto" takes it where the processor computes with it.
        compile: torch.compile; None means when a C++ compiler is at hand.
        threads: CPU threads of torch; None leaves torch's choice.
    """

    device: Literal["auto", "cpu", "cuda"] = "auto"
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    compile: bool | None = None
    threads: int | None = None

    def __post_init__(self) -> None:
        if self.device not in ("auto", "cpu", "cuda"):
            raise unknown_name("device", self.device, ("auto", "cpu", "cuda"))
        if self.precision not in PRECISIONS:
            raise unknown_name("precision", self.precision, PRECISIONS)
        if self.device == "cuda" and not torch.cuda.is_available():
            raise OptionError("there is no CUDA device: use --device cpu")
        if self.threads is not None and self.threads < 1:
            raise OptionError(f"threads must be at least 1, not {self.threads}")


class Engine:
    """A network placed on its device, with autocast and compilation as chosen.

    Args:
        network: the network; it is moved and keeps its own identity (for its state).
        options: the choices.
    """

    def __init__(self, network: nn.Module, options: DeviceOptions) -> None:
        if options.threads is not None:
            torch.set_num_threads(options.threads)
        kind = options.device
        if kind == "auto":
            kind = "cuda" if torch.cuda.is_available() else "cpu"
        self.device = torch.device(kind)
        # channels_last is faster by 40 % on CPUs, and what tensor cores want.
        self.network = network.to(self.device, memory_format=torch.channels_last)
        self.bfloat16 = options.precision == "bfloat16" or (
            options.precision == "auto" and _computes_bfloat16(self.device)
        )
        compiled = options.compile
        if compiled is None:
            compiled = kind == "cuda" or any(shutil.which(name) for name in ("g++", "clang++"))
        self.compiled = bool(compiled)
        self._may_fall_back = options.compile is None
        # Not dynamic: there are only as many shapes as stages, and each gets its own code.
        self._forward = (
            torch.compile(self.network, dynamic=False) if self.compiled else self.network
        )

    def images(self, rgb: torch.Tensor) -> torch.Tensor:
        """Turn (B, H, W, 3) uint8 into (B, 3, H, W) float32 in [0, 1], channels last."""
        return rgb.to(self.device).permute(0, 3, 1, 2).float().div_(255)

    def autocast(self) -> contextlib.AbstractContextManager:
        """Return the context that the forward pass of training runs in."""
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
            self.compiled, self._forward = False, self.network
            return self.logits(images)

    def describe(self) -> str:
        """Say in words how the network is run."""
        precision = "bfloat16" if self.bfloat16 else "float32"
        if self.bfloat16 and self.device.type == "cpu":
            precision += " (dilated convolutions float32)"
        return f"{self.device.type}, {precision}, {'compiled' if self.compiled else 'eager'}"


def _computes_bfloat16(device: torch.device) -> bool:
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported()
    capabilities = getattr(torch.cpu, "_is_avx512_bf16_supported", None)
    return bool(capabilities and capabilities())
