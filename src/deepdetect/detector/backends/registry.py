"""The backends that can run the network: one line each.

To add a backend, write its module beside this one with a function
`open_NAME(path, options) -> Network`, add its line, and its name to `interface.BACKENDS`.
"""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from ..._shared.errors import MissingWeightsError, OptionError, WeightsError, require_packages
from .interface import Network, RuntimeOptions, check_answer
from .onnxruntime_backend import open_onnxruntime
from .openvino_backend import open_openvino
from .torch_backend import open_torch


class _Backend(NamedTuple):
    packages: tuple[str, ...]
    suffix: str
    open: Callable[[Path, RuntimeOptions], Network]


_BACKENDS = {
    "onnxruntime": _Backend(("onnxruntime",), ".onnx", open_onnxruntime),
    "openvino": _Backend(("openvino",), ".onnx", open_openvino),
    "torch": _Backend(("torch", "safetensors"), ".safetensors", open_torch),
}


def open_network(path: Path, options: RuntimeOptions) -> tuple[Network, str]:
    """Load weights with the backend that fits, and return its name; a few networks are kept."""
    if not path.is_file():
        raise MissingWeightsError(f"there is no weights file {path}: check the path")
    name = _choose(path, options) if options.backend == "auto" else options.backend
    backend = _BACKENDS[name]
    if path.suffix.lower() != backend.suffix:
        raise OptionError(
            f"the backend {name} reads {backend.suffix} files, not {path.name}: "
            "leave the backend out, or give other weights"
        )
    options.check_backend(name)
    require_packages(f"reading {path.name} with the backend {name}", *backend.packages)
    file = path.stat()
    return _open(name, path, options, (path.absolute(), file.st_mtime_ns, file.st_size)), name


@functools.lru_cache(maxsize=4)
def _open(backend: str, path: Path, options: RuntimeOptions, state: tuple[object, ...]) -> Network:
    """Load a file; one whose state has changed since is loaded again."""
    network = _BACKENDS[backend].open(path, options)
    check_answer(network, path)
    return network


def _choose(path: Path, options: RuntimeOptions) -> str:
    suffix = path.suffix.lower()
    if suffix == ".safetensors":
        return "torch"
    if suffix != ".onnx":
        raise WeightsError(f"{path} is no weights file: it must end in .onnx or .safetensors")
    if options.precision != "float32":
        return "openvino"
    # OpenVINO is 1.5 times as fast on CPUs and gives the same probabilities to 1e-3.
    if options.device == "cpu" and importlib.util.find_spec("openvino") is not None:
        return "openvino"
    return "onnxruntime"
