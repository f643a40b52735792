"""The backend OpenVINO, an optional package, which alone can run the network in bfloat16."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..._shared.errors import OptionError
from ..._shared.runtimes import import_openvino
from ..pretrained import LOGITS, PADDED_IMAGE, POINTS
from .interface import RuntimeOptions, as_logits, failed_run, output_to_read, unreadable

COMPILED_LAYERS = 100
"""OpenVINO compiles layers for each image size, and caches at most this many. OpenVINO's default of
5000 would fill 0.5 GB if image sizes vary. Chosen by hand."""


_CORES: list[Any] = []
"""The one core of OpenVINO that all models share. If each model had a core, deleting cores could
free the thread's signal stack, and the next signal, such as Ctrl-C, would end the process (OpenVINO
2026.4; findings/openvino_cores.sh). The list is emptied if memory runs out, because compiling in
the same core would then crash."""


class OpenVinoNetwork:
    """A network run by OpenVINO on the CPU.

    If memory runs out, the next run reads and compiles the file again: the old model would give
    wrong results, and a model compiled again from the same graph would crash.
    """

    def __init__(
        self, compile_model: Callable[[], Any], path: Path, options: RuntimeOptions
    ) -> None:
        self._compile = compile_model
        self._model = compile_model()
        self._output_name = output_to_read([v.get_any_name() for v in self._model.outputs])
        self._path = path
        # Tiles, which are for float32 only, read the parts of the network from `onnx_path`.
        self.onnx_path = path if options.precision == "float32" else None
        self.threads = options.threads
        self._works = False  # whether a run has given a correct result

    def __call__(self, image: np.ndarray) -> np.ndarray:
        try:
            model = self._model
            if model is None:
                model = self._model = self._compile()
            request = model.create_infer_request()  # one per call, for concurrent threads
            output = request.infer([image], share_inputs=True)[self._output_name]
            # If memory is short, OpenVINO may return an empty map or that of the previous image.
            if self._works and output.shape[2:] != image.shape[2:]:
                raise MemoryError("OpenVINO gave a map of another size than the image")
        except Exception as error:  # OpenVINO's exceptions share no base class
            self._model = None
            _CORES.clear()
            raise failed_run(error, image.shape) from None
        logits = as_logits(output, self._output_name, image.shape, self._path)
        self._works = True
        return logits

    def release_memory(self) -> None:
        """Release the memory that the model keeps between runs."""
        # `release_memory` fails while another thread runs the model; before 2025 it was missing.
        with contextlib.suppress(Exception):
            self._model.release_memory()


def open_openvino(path: Path, options: RuntimeOptions) -> OpenVinoNetwork:
    """Load an ONNX file; a precision that the processor does not support raises an OptionError."""
    openvino = import_openvino()
    from openvino.frontend import FrontEndManager

    if options.precision == "bfloat16":
        known = openvino.Core().get_property("CPU", "OPTIMIZATION_CAPABILITIES")
        if "BF16" not in known:
            raise OptionError(
                "this processor has no instructions for bfloat16: leave `precision` out"
            )
    # The precision is always set: on newer CPUs the default is bfloat16, which moves keypoints.
    settings: dict[str, object] = {
        "INFERENCE_PRECISION_HINT": "bf16" if options.precision == "bfloat16" else "f32",
        "CPU_RUNTIME_CACHE_CAPACITY": COMPILED_LAYERS,
    }
    if options.threads is not None:
        settings["INFERENCE_NUM_THREADS"] = options.threads

    def compile_model() -> Any:
        # Without the name of the format OpenVINO tries all formats, and prints an error for each.
        reader = FrontEndManager().load_by_framework("onnx")
        graph = reader.convert(reader.load(str(path)))
        _keep_what_is_read(graph)
        if not _CORES:
            _CORES.append(openvino.Core())
        return _CORES[0].compile_model(graph, "CPU", settings)

    try:
        return OpenVinoNetwork(compile_model, path, options)
    except Exception as error:  # OpenVINO's exceptions share no base class
        raise unreadable(path, error) from None


def _keep_what_is_read(graph: Any) -> None:
    names = {name for value in graph.outputs for name in value.get_names()}
    unread = names - {LOGITS} if LOGITS in names else set(POINTS)
    for result in graph.get_results():
        own = result.output(0).get_names()
        if own & unread and LOGITS not in own:  # before version 2025, an output may have two names
            graph.remove_result(result)
    for node in graph.get_ordered_ops():
        for value in node.outputs():
            if PADDED_IMAGE in value.get_names():
                value.replace(graph.input(0))  # avoids a copy of 12 bytes per pixel
