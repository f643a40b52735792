"""The backend OpenVINO, an optional package, which alone can run the network in bfloat16."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ..._shared.errors import OptionError
from ..._shared.runtimes import import_openvino
from .interface import RuntimeOptions, not_started

COMPILED_LAYERS = 100
"""OpenVINO compiles layers for each image size, and caches at most this many. OpenVINO's default of
5000 would fill 0.5 GB if image sizes vary. Chosen by hand."""


_CORES: list[Any] = []
"""The one core of OpenVINO that all models share. If each model had a core, deleting cores could
free the thread's signal stack, and the next signal, such as Ctrl-C, would end the process (OpenVINO
2026.4; findings/openvino_cores.sh). The list is emptied if memory runs out, because compiling in
the same core would then crash."""


def _core() -> Any:
    if not _CORES:
        _CORES.append(import_openvino().Core())
    return _CORES[0]


class OpenVinoSession:
    """A graph run by OpenVINO.

    If memory runs out, the next run reads and compiles the graph again: the old model would give
    wrong results, and a model compiled again from the same graph would crash.
    """

    def __init__(self, compile_model: Callable[[], Any]) -> None:
        self._compile = compile_model
        self._model = compile_model()
        self.inputs = [value.get_any_name() for value in self._model.inputs]
        self.outputs = [value.get_any_name() for value in self._model.outputs]

    def run(self, outputs: Sequence[str], given: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        """Compute outputs."""
        model = self._model  # another thread may call `reload`
        if model is None:
            model = self._model = self._compile()
        request = model.create_infer_request()  # one per call, for concurrent threads
        found = request.infer({**given}, share_inputs=True)
        return [found[name] for name in outputs]

    def reload(self) -> None:
        """Compile the graph again before the next run."""
        self._model = None
        _CORES.clear()

    def release_memory(self, smallest: Mapping[str, np.ndarray]) -> None:
        """Release the memory that the model keeps between runs; no run is needed."""
        # `release_memory` fails while another thread runs the model; before 2025 it was missing.
        with contextlib.suppress(Exception):
            self._model.release_memory()


def open_openvino(model: bytes | str, options: RuntimeOptions) -> OpenVinoSession:
    """Load an ONNX graph or the file of one.

    A missing device or an unsupported precision raises an OptionError.
    """
    import_openvino()
    from openvino.frontend import FrontEndManager

    device = options.device.upper()
    available = _core().available_devices
    if not any(each == device or each.startswith(f"{device}.") for each in available):
        raise OptionError(
            f"OpenVINO finds no device {options.device} here: use {' or '.join(available).lower()}"
        )
    if options.precision == "bfloat16":
        known = _core().get_property(device, "OPTIMIZATION_CAPABILITIES")
        if "BF16" not in known:
            raise OptionError(
                "this processor has no instructions for bfloat16: leave `precision` out"
            )
    # The precision is always set: on newer CPUs the default is bfloat16, which moves keypoints.
    settings: dict[str, object] = {
        "INFERENCE_PRECISION_HINT": "bf16" if options.precision == "bfloat16" else "f32"
    }
    if device == "CPU":
        settings["CPU_RUNTIME_CACHE_CAPACITY"] = COMPILED_LAYERS
        if options.threads is not None:
            settings["INFERENCE_NUM_THREADS"] = options.threads

    def compile_model() -> Any:
        # Without the name of the format OpenVINO tries all formats, and prints an error for each.
        reader = FrontEndManager().load_by_framework("onnx")
        graph = reader.convert(reader.load(model if isinstance(model, str) else io.BytesIO(model)))
        try:
            return _core().compile_model(graph, device, settings)
        except Exception as error:  # OpenVINO's exceptions share no base class
            if device == "CPU":
                raise
            raise not_started(options.device, error) from None

    return OpenVinoSession(compile_model)
