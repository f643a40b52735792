"""What a loaded network is, and how it is run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from ..._shared.errors import OptionError, unknown_name
from ..._shared.options import suggest_keywords

BACKENDS = ("onnxruntime", "openvino", "torch")

PRECISIONS = ("float32", "bfloat16")


class Network(Protocol):
    """A loaded network."""

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Map (N, 3, H, W) float32 in [0, 1] to (N, 1, H, W) float32 logits, all finite.

        H and W are multiples of 8. The logits are those of the probability of a keypoint.

        Raises:
            WeightsError: the network returns a map of another size, or values that are not finite.
        """


@suggest_keywords
@dataclass(frozen=True)
class RuntimeOptions:
    """How the network is run.

    Attributes:
        backend: "auto", "onnxruntime", "openvino" or "torch". "auto" takes torch for
            safetensors weights, else OpenVINO for the device "cpu" when it is installed, else
            ONNX Runtime.
        device: "cpu"; or, with ONNX Runtime, "cuda", or the name of an execution provider,
            as "TensorrtExecutionProvider".
        threads: number of threads; None leaves the backend's choice.
        precision: what the network computes with, "float32" or "bfloat16": that is faster where
            the processor has instructions for it, needs OpenVINO, moves a few keypoints, and is not
            for images in tiles.

    Raises:
        OptionError: the backend is unknown or a value is out of its range.
    """

    backend: str = "auto"
    device: str = "cpu"
    threads: int | None = None
    precision: Literal["float32", "bfloat16"] = "float32"

    def __post_init__(self) -> None:
        if self.backend not in ("auto", *BACKENDS):
            raise unknown_name("backend", self.backend, ("auto", *BACKENDS))
        if self.threads is not None and self.threads < 1:
            raise OptionError(f"threads must be at least 1, not {self.threads}")
        if self.precision not in PRECISIONS:
            raise unknown_name("precision", self.precision, PRECISIONS)
        if self.device != "cpu" and self.precision != "float32":
            raise OptionError(
                f'`precision="{self.precision}"` needs openvino, and `device="{self.device}"` '
                "onnxruntime: leave one of them out"
            )
        if self.backend != "auto":
            self.check_backend(self.backend)

    def check_backend(self, backend: str) -> None:
        """Raise an OptionError if a backend has not what is asked of it."""
        if self.precision != "float32" and backend != "openvino":
            raise OptionError(
                f'`precision="{self.precision}"` needs the backend openvino, not {backend}: leave '
                "one of them out"
            )
        if self.device != "cpu" and backend != "onnxruntime":
            raise OptionError(
                f'`device="{self.device}"` needs the backend onnxruntime, not {backend}: leave one '
                "of them out"
            )
