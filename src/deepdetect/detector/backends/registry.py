"""The registry of the backends that can run the network.

To add a backend, write a module in this folder with a function `open_NAME(path, options) ->
Network`, and add the function to `BACKENDS`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..._shared.errors import (
    DeepDetectError,
    OptionError,
    WeightsError,
    check_name,
    require_packages,
)
from ..._shared.options import check_ranges
from .interface import PROBE_SHAPE, Network, RuntimeOptions
from .onnxruntime_backend import open_onnxruntime
from .openvino_backend import open_openvino

BACKENDS: dict[str, Callable[[Path, RuntimeOptions], Network]] = {
    "onnxruntime": open_onnxruntime,
    "openvino": open_openvino,
}
"""Functions that open a weights file, by backend. Backends are named after Python packages."""

PRECISIONS = ("float32", "bfloat16")


def open_network(path: Path, options: RuntimeOptions) -> tuple[Network, str]:
    """Load weights, unless they are cached; return the network and the name of its backend."""
    check_name("backend", options.backend, ("auto", *BACKENDS))
    check_name("precision", options.precision, PRECISIONS)
    check_ranges(options, counts=("threads",))
    if path.suffix.lower() != ".onnx":
        raise WeightsError(
            f"{path} is not an ONNX file: convert safetensors by `deepdetect dev average` of "
            "the package deepdetect-lab"
        )
    name = options.backend
    if name == "auto":
        name = "onnxruntime" if options.precision == "float32" else "openvino"
    for option, usual, needed in (
        ("precision", "float32", "openvino"),
        ("device", "cpu", "onnxruntime"),
    ):
        value = getattr(options, option)
        if value != usual and name != needed:
            raise OptionError(
                f'`{option}="{value}"` needs the backend {needed}, not {name}: leave one out'
            )
    require_packages(f"reading {path.name} with the backend {name}", name)
    file = path.stat()
    return _open(name, path, options, (path.absolute(), file.st_mtime_ns, file.st_size)), name


@functools.lru_cache(maxsize=4)
def _open(backend: str, path: Path, options: RuntimeOptions, state: tuple[object, ...]) -> Network:
    """Load and check a file, unless it is cached with the same `state` (path, time, size)."""
    network = BACKENDS[backend](path, options)
    # A run on a small image of noise rejects unsuitable weights. Multiples of 40503 modulo 2**16
    # serve as noise, because importing NumPy's random generators would take 6 MB.
    numbers = np.arange(3 * math.prod(PROBE_SHAPE), dtype=np.uint16) * np.uint16(40503)
    noise = numbers.reshape(1, 3, *PROBE_SHAPE).astype(np.float32) * np.float32(2**-16)
    try:
        logits = network(noise)
    except WeightsError:
        raise
    except DeepDetectError as error:
        raise WeightsError(
            f"{path} does not fit: it must map an image (1, 3, height, width) of any size to a "
            f"map (1, 1, height, width), but {error}"
        ) from None
    if logits.min() == logits.max():
        raise WeightsError(
            f"{path} gives the same value at every pixel of an image of noise: it is damaged, or "
            "was never trained; use other weights"
        )
    return network
