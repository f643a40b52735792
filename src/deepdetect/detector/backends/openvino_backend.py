"""OpenVINO: 1.5 times as fast as ONNX Runtime on CPUs, an extra."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np

from ..._shared.errors import DeepDetectError, OptionError, WeightsError
from .options import RuntimeOptions
from .shapes import (
    KEYPOINT_OUTPUTS,
    LOGITS,
    PADDED_IMAGE,
    as_logits,
    check_network,
    failed_run,
    lack_of_memory,
    output_to_read,
)
from .without_telemetry import import_openvino

COMPILED_LAYERS = 100
"""Layers compiled for one size of image that are kept, the least recently used are dropped first.

OpenVINO's own limit is 5000, which images of ever new sizes fill with half a gigabyte.
"""


class OpenVinoNetwork:
    """A network run by OpenVINO on the CPU.

    Args:
        model: compiled.
        compile_model: reads and compiles it again: after memory was short, the answers of a model
            are wrong, and one compiled from the same graph crashes.
        output_name: of the output to read.
        path: the weights file.
        options: how it is run.
    """

    bytes_per_pixel = 260
    """Of memory that a run takes, about."""

    def __init__(
        self,
        model: Any,
        compile_model: Callable[[], Any],
        output_name: str,
        path: Path,
        options: RuntimeOptions,
    ) -> None:
        self._model = model
        self._compile = compile_model
        self._output_name = output_name
        self._path = path
        # Tiles are computed in float32.
        self.onnx_path = path if options.precision == "float32" else None
        self.threads = options.threads
        self._local = threading.local()
        self._lock = threading.Lock()
        self._works = False  # it has given a right answer

    def __call__(self, image: np.ndarray) -> np.ndarray:
        model, request = self._request(image.shape)
        try:
            output = request.infer([image], share_inputs=True)[self._output_name]
        except Exception as error:  # its exceptions share no base class
            self._discard(model)
            raise _failure(error, image.shape) from None
        # Where memory is short it may also answer with nothing, or with the map of the last image.
        stale = not output.size or output.shape == self._local.output_shape
        fits = output.shape[:1] + output.shape[2:] == image.shape[:1] + image.shape[2:]
        if self._works and stale and not fits:
            self._discard(model)
            raise lack_of_memory(image.shape)
        logits = as_logits(output, self._output_name, image.shape, self._path)
        self._local.output_shape, self._works = output.shape, True
        return logits

    def release_memory(self) -> None:
        """Give back what is kept from one run for the next: 260 bytes a pixel."""
        # It refuses while another thread runs it, and versions before 2025 do not have it.
        with contextlib.suppress(Exception):
            self._model.release_memory()

    def _request(self, image_shape: tuple[int, ...]) -> tuple[Any, Any]:
        """Return the model and this thread's request: one holds an image at a time."""
        try:
            with self._lock:
                if self._model is None:
                    self._model = self._compile()
                model = self._model
            if getattr(self._local, "model", None) is not model:
                self._local.request = model.create_infer_request()
                self._local.model, self._local.output_shape = model, None
        except Exception as error:  # as above
            raise _failure(error, image_shape) from None
        return model, self._local.request

    def _discard(self, model: Any) -> None:
        """Let the next call compile the model again."""
        self._local.model = self._local.request = None
        with self._lock:
            if self._model is model:
                self._model = None


def open_openvino(path: Path, options: RuntimeOptions) -> OpenVinoNetwork:
    """Load an ONNX file.

    Raises:
        WeightsError: the file is damaged or is another network.
        OptionError: the processor has no instructions for the precision.
    """
    openvino = import_openvino()
    from openvino.frontend import FrontEndManager

    if options.precision == "bfloat16" and not computes_bfloat16():
        raise OptionError("this processor has no instructions for bfloat16: leave `precision` out")
    # Its default on newer CPUs is bfloat16, which moves keypoints.
    settings: dict[str, object] = {
        "INFERENCE_PRECISION_HINT": "bf16" if options.precision == "bfloat16" else "f32",
        "CPU_RUNTIME_CACHE_CAPACITY": COMPILED_LAYERS,
    }
    if options.threads is not None:
        settings["INFERENCE_NUM_THREADS"] = options.threads

    def read() -> Any:
        # Named, not guessed: guessing tries all formats and prints each one's complaint.
        reader = FrontEndManager().load_by_framework("onnx")
        graph = reader.convert(reader.load(str(path)))
        _take_out(graph, KEYPOINT_OUTPUTS)
        return graph

    def compile_model(graph: Any = None) -> Any:
        graph = read() if graph is None else graph
        names = {name for value in graph.outputs for name in value.get_names()}
        if LOGITS in names:
            _take_out(graph, names - {LOGITS})
        _take_out_padding(graph)
        # A new core: one that memory was short for crashes.
        return openvino.Core().compile_model(graph, "CPU", settings)

    try:
        graph = read()
        # A network of one size has no padding to take out.
        check_network(
            path,
            [_shape(value) for value in graph.inputs],
            [_shape(value) for value in graph.outputs],
            {str(value.get_element_type().to_dtype()) for value in [*graph.inputs, *graph.outputs]},
        )
        model = compile_model(graph)
    except WeightsError:
        raise
    except Exception as error:  # its exceptions share no base class
        reason = str(error).strip().splitlines()[-1]
        raise WeightsError(
            f"{path} is not an ONNX file that can be read ({reason}): download it again"
        ) from None
    output = output_to_read([value.get_any_name() for value in model.outputs])
    return OpenVinoNetwork(model, compile_model, output, path, options)


def computes_bfloat16() -> bool:
    """Return whether this processor has instructions for `precision="bfloat16"`."""
    capabilities = import_openvino().Core().get_property("CPU", "OPTIMIZATION_CAPABILITIES")
    return bool("BF16" in capabilities)


def _take_out(graph: Any, names: Collection[str]) -> None:
    """Do not compute the outputs of these names, which nobody reads."""
    for result in graph.get_results():
        if not result.output(0).get_names().isdisjoint(names):
            graph.remove_result(result)


def _take_out_padding(graph: Any) -> None:
    """Let the network read the image itself: it comes padded, and a copy takes 12 bytes a pixel."""
    for node in graph.get_ordered_ops():
        for value in node.outputs():
            if PADDED_IMAGE in value.get_names():
                value.replace(graph.input(0))


def _failure(error: Exception, image_shape: tuple[int, ...]) -> DeepDetectError:
    """Return the error of a run that failed."""
    lines = str(error).strip().splitlines() or [type(error).__name__]
    if isinstance(error, MemoryError) or any(
        words in str(error) for words in ("allocate", "bad_alloc")
    ):
        return lack_of_memory(image_shape)
    return failed_run(image_shape, lines[-1], "the backend onnxruntime")


def _shape(value: Any) -> list[int | str]:
    """Return a shape with the free dimensions as text, as ONNX Runtime gives it."""
    return [
        "free" if dimension.is_dynamic else dimension.get_length()
        for dimension in value.get_partial_shape()
    ]
