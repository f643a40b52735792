"""The backend ONNX Runtime, which is always installed."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..._shared.errors import OptionError, unknown_name
from ..._shared.runtimes import CPU, CUDA, import_onnxruntime, start_session
from .interface import RuntimeOptions, not_started

PROVIDERS = {"cpu": CPU, "cuda": CUDA}


class OnnxRuntimeSession:
    """A graph run by ONNX Runtime."""

    def __init__(self, session: Any) -> None:
        self._session = session
        self.inputs = [value.name for value in session.get_inputs()]
        self.outputs = [value.name for value in session.get_outputs()]

    def run(self, outputs: Sequence[str], given: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        """Compute outputs."""
        found: list[np.ndarray] = self._session.run([*outputs], {**given})
        return found

    def reload(self) -> None:
        """Do nothing, because a failed run damages nothing."""

    def release_memory(self, smallest: Mapping[str, np.ndarray]) -> None:
        """Release the memory that the session keeps between runs."""
        settings = import_onnxruntime().RunOptions()
        settings.add_run_config_entry("memory.enable_memory_arena_shrinkage", "cpu:0")
        # ONNX Runtime raises an error if it keeps no memory on the CPU.
        with contextlib.suppress(Exception):
            self._session.run(self.outputs, {**smallest}, settings)


def open_onnxruntime(model: bytes | str, options: RuntimeOptions) -> OnnxRuntimeSession:
    """Load an ONNX graph or the file of one; a missing device raises an OptionError."""
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
        session = start_session(model, options.threads, provider)
    except Exception as error:  # ONNX Runtime's exceptions share no base class
        if provider == CPU:
            raise
        raise not_started(device, error) from None
    # If a provider cannot start, ONNX Runtime silently continues on the CPU.
    if provider not in session.get_providers():
        raise not_started(device, "no reason given")
    return OnnxRuntimeSession(session)
