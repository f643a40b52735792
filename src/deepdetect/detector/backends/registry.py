"""The registry of the backends that can run networks.

To add a backend, write a module in this folder with a function `open_NAME(model, options) ->
Session`, and add the function to `BACKENDS`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..._shared.errors import (
    DeepDetectError,
    OptionError,
    WeightsError,
    check_name,
    require_packages,
)
from ..._shared.machine import thread_limit
from ..._shared.options import check_ranges
from ..pretrained import LOGITS, PADDED_IMAGE, PADDED_LOGITS
from .interface import PROBE_SHAPE, Network, OnnxNetwork, RuntimeOptions, Session, unreadable
from .onnx_parts import cut_onnx
from .onnxruntime_backend import open_onnxruntime
from .openvino_backend import open_openvino

BACKENDS: dict[str, Callable[[bytes | str, RuntimeOptions], Session]] = {
    "onnxruntime": open_onnxruntime,
    "openvino": open_openvino,
}
"""Functions that open an ONNX graph, by backend. Backends are named after Python packages."""

PRECISIONS = ("float32", "bfloat16")

NETWORKS = ((PADDED_IMAGE,), (PADDED_LOGITS,)), (("image",), (LOGITS,))
"""Inputs and outputs of the parts of an ONNX file that may be the network; the first is taken."""

Ends = tuple[tuple[str, ...], tuple[str, ...]]


def backend_name(options: RuntimeOptions) -> str:
    """Check options; return the name of the backend that they choose."""
    check_name("backend", options.backend, ("auto", *BACKENDS))
    check_name("precision", options.precision, PRECISIONS)
    check_ranges(options, counts=("threads",))
    name = options.backend
    if name == "auto":
        name = "onnxruntime" if options.precision == "float32" else "openvino"
    if options.precision != "float32" and name != "openvino":
        raise OptionError(
            f'`precision="{options.precision}"` needs the backend openvino, not {name}: leave one '
            "out"
        )
    return name


def open_network(path: Path, options: RuntimeOptions) -> tuple[Network, str]:
    """Load weights, unless they are cached; return the network and the name of its backend."""
    name = backend_name(options)
    if path.suffix.lower() != ".onnx":
        raise WeightsError(
            f"{path} is not an ONNX file: convert safetensors by `deepdetect dev average` of "
            "the package deepdetect-lab"
        )
    return _network(path, options, _state(path)), name


def open_graph(path: Path, options: RuntimeOptions, *parts: Ends) -> Session:
    """Load the first of the `parts` that an ONNX file has, otherwise the whole file.

    Parts are given by their inputs and outputs (see `cut_onnx`). Sessions are cached.
    """
    options = replace(options, threads=options.threads or thread_limit())
    return _graph(path, options, parts, _state(path))


def _state(path: Path) -> tuple[object, ...]:
    file = path.stat()
    return path.absolute(), file.st_mtime_ns, file.st_size


@functools.lru_cache(maxsize=8)
def _graph(
    path: Path, options: RuntimeOptions, parts: Sequence[Ends], state: tuple[object, ...]
) -> Session:
    """Load a part of a file, unless it is cached with the same `state` (path, time, size)."""
    name = backend_name(options)
    require_packages(f"reading {path.name} with the backend {name}", name)
    model = path.read_bytes()
    for part in (*parts, None):
        try:
            return BACKENDS[name](cut_onnx(model, *part) if part else str(path), options)
        except DeepDetectError:
            raise
        except Exception as error:  # Protobuf's and the runtimes' exceptions share no base class
            if part is None:
                raise unreadable(path, error) from None
    raise AssertionError("the last part is the whole file")


@functools.lru_cache(maxsize=4)
def _network(path: Path, options: RuntimeOptions, state: tuple[object, ...]) -> Network:
    """Load and check a file, unless it is cached with the same `state` (path, time, size)."""
    network = OnnxNetwork(open_graph(path, options, *NETWORKS), path, options)
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
