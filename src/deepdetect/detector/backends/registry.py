"""The programs that can run the network: one line each.

To add a backend, write its module beside this one with a function
`open_NAME(path, options) -> Network` and add its line.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from ..._shared.errors import MissingExtraError, OptionError, WeightsError, unknown_name
from .onnxruntime_backend import open_onnxruntime
from .openvino_backend import open_openvino
from .torch_backend import open_torch


class Network(Protocol):
    """A loaded network."""

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Map (1, 3, H, W) float32 in [0, 1] to (1, 1, H, W) float32 logits, all finite.

        H and W are multiples of 8. The logits are those of the probability of a keypoint.

        Raises:
            WeightsError: the network gives a map of another size, or values that are no number.
        """


@dataclass(frozen=True)
class RuntimeOptions:
    """How the network is run.

    Attributes:
        backend: "auto", "onnxruntime", "openvino" or "torch". "auto" takes torch for
            safetensors weights, else OpenVINO when it is installed and no provider is
            named, else ONNX Runtime.
        providers: names of ONNX Runtime's execution providers, the preferred one first,
            as ("CUDAExecutionProvider",); empty means its CPU provider.
        threads: number of threads; None leaves the backend's choice.

    Raises:
        OptionError: the backend is unknown or a value is out of its range.
    """

    backend: str = "auto"
    providers: tuple[str, ...] = ()
    threads: int | None = None

    def __post_init__(self) -> None:
        if isinstance(self.providers, str):
            object.__setattr__(self, "providers", (self.providers,))
        if self.backend != "auto" and self.backend not in BACKENDS:
            raise unknown_name("backend", self.backend, ("auto", *BACKENDS))
        if self.threads is not None and self.threads < 1:
            raise OptionError(f"threads must be at least 1, not {self.threads}")
        if self.providers and self.backend not in ("auto", "onnxruntime"):
            raise _foreign_providers(self.backend)


@dataclass(frozen=True)
class Backend:
    """A backend: its packages, the weights it reads, and the function that loads them."""

    packages: tuple[str, ...]
    suffixes: tuple[str, ...]
    open: Callable[[Path, RuntimeOptions], Network]


BACKENDS: dict[str, Backend] = {
    "onnxruntime": Backend(("onnxruntime",), (".onnx",), open_onnxruntime),
    "openvino": Backend(("openvino",), (".onnx",), open_openvino),
    "torch": Backend(("torch", "safetensors"), (".safetensors",), open_torch),
}


def open_network(path: Path, options: RuntimeOptions) -> tuple[Network, str]:
    """Load weights with the backend that fits.

    Args:
        path: an ONNX or safetensors file.
        options: the backend and its settings.

    Returns:
        The network, and the backend's name.

    Raises:
        WeightsError: the file is missing, damaged, or does not fit.
        MissingExtraError: the backend is not installed.
        OptionError: the backend does not read such files.
    """
    if not path.is_file():
        raise WeightsError(f"there is no weights file {path}: check the path")
    name = options.backend
    if name == "auto":
        name = _choose(path, options)
    backend = BACKENDS[name]
    if path.suffix.lower() not in backend.suffixes:
        raise OptionError(
            f"the backend {name} reads {' or '.join(backend.suffixes)} files, not {path.name}: "
            "leave the backend out, or give other weights"
        )
    if options.providers and name != "onnxruntime":
        raise _foreign_providers(name)
    for package in backend.packages:
        if importlib.util.find_spec(package) is None:
            raise MissingExtraError(
                f"reading {path.name} with the backend {name} needs the package {package}, "
                f"which is not installed: run pip install {package}"
            )
    return backend.open(path, options), name


def _foreign_providers(backend: str) -> OptionError:
    return OptionError(f"providers belong to onnxruntime, not to {backend}: leave one of them out")


def _choose(path: Path, options: RuntimeOptions) -> str:
    suffix = path.suffix.lower()
    if suffix == ".safetensors":
        return "torch"
    if suffix != ".onnx":
        raise WeightsError(f"{path} is no weights file: it must end in .onnx or .safetensors")
    # OpenVINO is 1.5 times as fast on CPUs and gives the same probabilities to 1e-3.
    if not options.providers and importlib.util.find_spec("openvino") is not None:
        return "openvino"
    return "onnxruntime"
