"""The backend ONNX Runtime, which is always installed."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import numpy as np

from ..._shared.errors import OptionError, first_line, unknown_name
from ..._shared.runtimes import CPU, import_onnxruntime, start_session
from ..pretrained import LOGITS, POINTS
from .interface import (
    PROBE_SHAPE,
    RuntimeOptions,
    as_logits,
    failed_run,
    output_to_read,
    unreadable,
)
from .onnx_parts import cut_onnx

PROVIDERS = {"cpu": CPU, "cuda": "CUDAExecutionProvider"}


class OnnxRuntimeNetwork:
    """A network run by ONNX Runtime."""

    def __init__(self, session: Any, path: Path, threads: int | None) -> None:
        self._session = session
        self._input_name = session.get_inputs()[0].name
        self._output_name = output_to_read([value.name for value in session.get_outputs()])
        self.onnx_path = path
        self.threads = threads

    def __call__(self, image: np.ndarray) -> np.ndarray:
        try:
            output = self._session.run([self._output_name], {self._input_name: image})[0]
        except Exception as error:  # ONNX Runtime's exceptions share no base class
            raise failed_run(error, image.shape) from None
        return as_logits(output, self._output_name, image.shape, self.onnx_path)

    def release_memory(self) -> None:
        """Release the memory that the session keeps between runs."""
        settings = import_onnxruntime().RunOptions()
        settings.add_run_config_entry("memory.enable_memory_arena_shrinkage", "cpu:0")
        smallest = np.zeros((1, 3, *PROBE_SHAPE), np.float32)
        # ONNX Runtime raises an error if it keeps no memory on the CPU.
        with contextlib.suppress(Exception):
            self._session.run([self._output_name], {self._input_name: smallest}, settings)


def open_onnxruntime(path: Path, options: RuntimeOptions) -> OnnxRuntimeNetwork:
    """Load an ONNX file; a device that is not available raises an OptionError."""
    onnxruntime = import_onnxruntime()
    device = options.device
    provider = PROVIDERS.get(device, device)
    known, available = onnxruntime.get_all_providers(), onnxruntime.get_available_providers()
    if provider not in known:
        raise unknown_name("device", device, (*PROVIDERS, *known))
    if provider not in available:
        build = "onnxruntime-gpu in its place" if device == "cuda" else "a build with this device"
        raise OptionError(
            f"the installed onnxruntime does not have the device {device}: install {build}, or use "
            f"{' or '.join(['cpu', *(name for name in available if name != CPU)])}"
        )
    try:
        session = start_session(_logits_only(path), options.threads, provider)
    except Exception as error:  # ONNX Runtime's exceptions share no base class
        raise unreadable(path, error) if provider == CPU else _not_started(device, error) from None
    # If a provider cannot start, ONNX Runtime silently continues on the CPU.
    if provider not in session.get_providers():
        raise _not_started(device, "no reason given")
    return OnnxRuntimeNetwork(session, path, options.threads)


def _not_started(device: str, reason: object) -> OptionError:
    return OptionError(
        f"the device {device} could not start ({first_line(reason)}): check its driver "
        "and libraries, or leave `device` out"
    )


def _logits_only(path: Path) -> str | bytes:
    """Return the path of an ONNX file or, if it also outputs keypoints, a copy without them."""
    # ONNX Runtime would compute all outputs of a file, even those that are not requested.
    model = path.read_bytes()
    if all(name.encode() in model for name in (LOGITS, *POINTS)):
        with contextlib.suppress(KeyError):
            return cut_onnx(model, ["image"], [LOGITS])
    return str(path)
