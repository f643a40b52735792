"""ONNX Runtime: the backend that is always installed."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import numpy as np

from ..._shared.errors import OptionError, WeightsError, unknown_name
from .onnx_parts import leave_out_outputs
from .options import RuntimeOptions
from .shapes import (
    KEYPOINT_OUTPUTS,
    PROBE_SHAPE,
    as_logits,
    check_network,
    failed_run,
    lack_of_memory,
    output_to_read,
)
from .without_telemetry import import_onnxruntime

CPU = "CPUExecutionProvider"
PROVIDERS = {"cpu": CPU, "cuda": "CUDAExecutionProvider"}


class OnnxRuntimeNetwork:
    """A network run by ONNX Runtime."""

    bytes_per_pixel = 150
    """Of memory that a run takes, about."""

    def __init__(
        self, session: Any, input_name: str, output_name: str, path: Path, threads: int | None
    ) -> None:
        self._session = session
        self._input_name = input_name
        self._output_name = output_name
        self.onnx_path = path
        self.threads = threads

    def __call__(self, image: np.ndarray) -> np.ndarray:
        try:
            output = self._session.run([self._output_name], {self._input_name: image})[0]
        except Exception as error:  # its exceptions share no base class
            if any(words in str(error) for words in ("allocate memory", "bad_alloc")):
                raise lack_of_memory(image.shape) from None
            reason = str(error).splitlines()[0]
            raise failed_run(image.shape, reason, "another device") from None
        return as_logits(output, self._output_name, image.shape, self.onnx_path)

    def release_memory(self) -> None:
        """Give back what is kept from one run for the next: 150 bytes a pixel."""
        settings = import_onnxruntime().RunOptions()
        settings.add_run_config_entry("memory.enable_memory_arena_shrinkage", "cpu:0")
        smallest = np.zeros((1, 3, *PROBE_SHAPE), np.float32)
        # Where there is nothing of the processor's to be given back, it raises an error.
        with contextlib.suppress(Exception):
            self._session.run([self._output_name], {self._input_name: smallest}, settings)


def open_onnxruntime(path: Path, options: RuntimeOptions) -> OnnxRuntimeNetwork:
    """Load an ONNX file.

    Raises:
        WeightsError: the file is damaged or is another network.
        OptionError: the device is unknown or not available.
    """
    onnxruntime = import_onnxruntime()
    device = options.device
    provider = PROVIDERS.get(device, device)
    known, available = onnxruntime.get_all_providers(), onnxruntime.get_available_providers()
    if provider not in known:
        raise unknown_name("device", device, (*PROVIDERS, *known))
    if provider not in available:
        build = "onnxruntime-gpu in its place" if device == "cuda" else "the build that has it"
        raise OptionError(
            f"the installed onnxruntime does not have the device {device}: install {build}, or use "
            f"{' or '.join(['cpu', *(name for name in available if name != CPU)])}"
        )
    settings = onnxruntime.SessionOptions()
    settings.log_severity_level = 4  # what fails is said by the exception, and by us
    if options.threads is not None:
        settings.intra_op_num_threads = options.threads

    try:
        # Falling back to the CPU after a failure, it would print blocks of text.
        session = onnxruntime.InferenceSession(
            _maps_only(path), settings, providers=[provider], enable_fallback=0
        )
    except Exception as error:  # its exceptions share no base class
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        if provider != CPU:
            raise OptionError(
                f"the device {device} could not start with {path} ({reason}): check its driver and "
                "libraries, or leave it out"
            ) from None
        raise WeightsError(
            f"{path} is not an ONNX file that can be read ({reason}): download it again"
        ) from None
    # It goes on with the CPU when a provider cannot start, and says so in a log only.
    session.disable_fallback()
    session._model_bytes = None  # the content of the file, which it keeps for falling back
    if provider not in session.get_providers():
        raise OptionError(
            f"the device {device} could not start: check its driver and libraries, or leave it out"
        )
    inputs = session.get_inputs()
    outputs = session.get_outputs()
    check_network(
        path,
        [value.shape for value in inputs],
        [value.shape for value in outputs],
        # It says "tensor(float)" for float32.
        {
            "float32" if value.type == "tensor(float)" else value.type
            for value in [*inputs, *outputs]
        },
    )
    output = output_to_read([value.name for value in outputs])
    return OnnxRuntimeNetwork(session, inputs[0].name, output, path, options.threads)


def _maps_only(path: Path) -> str | bytes:
    """Return the content of a file that gives keypoints, too, without them; else its path."""
    with contextlib.suppress(OSError, KeyError):  # ONNX Runtime says what is wrong
        model = path.read_bytes()
        without = leave_out_outputs(model, KEYPOINT_OUTPUTS)
        if without is not model:
            return without
    return str(path)
