"""OpenVINO: 1.5 times as fast as ONNX Runtime on CPUs, an extra."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np

from ..._shared.errors import WeightsError
from .options import RuntimeOptions
from .shapes import as_logits, check_network, output_to_read
from .without_telemetry import import_openvino


class OpenVinoNetwork:
    """A network run by OpenVINO on the CPU."""

    def __init__(self, model: Any, output_name: str, path: Path) -> None:
        self._model = model
        self._output_name = output_name
        self._path = path
        self._local = threading.local()

    def __call__(self, image: np.ndarray) -> np.ndarray:
        # A request holds one image at a time, so each thread gets its own.
        if not hasattr(self._local, "request"):
            self._local.request = self._model.create_infer_request()
        outputs = self._local.request.infer([image], share_inputs=True)
        return as_logits(outputs[self._output_name], self._output_name, image.shape, self._path)


def open_openvino(path: Path, options: RuntimeOptions) -> OpenVinoNetwork:
    """Load an ONNX file.

    Raises:
        WeightsError: the file is damaged or is another network.
    """
    openvino = import_openvino()
    from openvino.frontend import FrontEndManager

    # Its default on newer CPUs is bfloat16, which moves keypoints.
    settings: dict[str, object] = {"INFERENCE_PRECISION_HINT": "f32"}
    if options.threads is not None:
        settings["INFERENCE_NUM_THREADS"] = options.threads
    try:
        # Named, not guessed: guessing tries all formats and prints each one's complaint.
        reader = FrontEndManager().load_by_framework("onnx")
        model = openvino.Core().compile_model(
            reader.convert(reader.load(str(path))), "CPU", settings
        )
    except Exception as error:  # its exceptions share no base class
        reason = str(error).strip().splitlines()[-1]
        raise WeightsError(
            f"{path} is not an ONNX file that can be read ({reason}): download it again"
        ) from None
    check_network(
        path,
        [_shape(value) for value in model.inputs],
        [_shape(value) for value in model.outputs],
        {str(value.get_element_type().to_dtype()) for value in [*model.inputs, *model.outputs]},
    )
    output = output_to_read([value.get_any_name() for value in model.outputs])
    return OpenVinoNetwork(model, output, path)


def _shape(value: Any) -> list[int | str]:
    """Return a shape with the free dimensions as text, as ONNX Runtime gives it."""
    return [
        "free" if dimension.is_dynamic else dimension.get_length()
        for dimension in value.get_partial_shape()
    ]
