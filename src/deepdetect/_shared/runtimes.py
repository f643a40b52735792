"""ONNX Runtime and OpenVINO: imported without telemetry, and sessions of the first."""

from __future__ import annotations

import importlib
import os
import sys
import threading
from collections.abc import MutableMapping
from types import ModuleType
from typing import Any

from .machine import thread_limit

CPU = "CPUExecutionProvider"

_import_lock = threading.Lock()


def import_onnxruntime() -> ModuleType:
    """Import ONNX Runtime with ORT_DISABLE_TELEMETRY=1, unless the user has set it."""
    # It is read during the import: disable_telemetry_events() would come too late.
    variable = "ORT_DISABLE_TELEMETRY"
    return _import_with("onnxruntime", os.environ, variable, os.environ.get(variable, "1"))


def import_openvino() -> ModuleType:
    """Import OpenVINO as if openvino_telemetry were not installed, which it is prepared for."""
    # Only the variable CI would switch it off, which other packages read too.
    return _import_with("openvino", sys.modules, "openvino_telemetry", None)


def _import_with(
    package: str, entries: MutableMapping[str, Any], key: str, value: object
) -> ModuleType:
    """Import a package while an entry has a value; then put back what was there.

    Both packages start telemetry when they are imported: they write an identifier into the home
    folder, and OpenVINO sends an event. One that was imported before is left as it is.
    """
    with _import_lock:
        if package in sys.modules:
            return importlib.import_module(package)
        before = dict(entries)
        entries[key] = value
        try:
            return importlib.import_module(package)
        finally:
            if key in before:
                entries[key] = before[key]
            else:
                entries.pop(key, None)


def start_session(
    model: str | bytes,
    threads: int | None = None,
    provider: str = CPU,
    keep_memory: bool = True,
) -> Any:
    """Start a session that prints nothing, for a file or its content."""
    onnxruntime = import_onnxruntime()
    settings = onnxruntime.SessionOptions()
    settings.log_severity_level = 4  # what fails is said by the exception, and by us
    settings.enable_cpu_mem_arena = settings.enable_mem_pattern = keep_memory
    # Threads that spin begin sooner, but take processors from what follows, long after each run.
    settings.add_session_config_entry("session.intra_op.allow_spinning", "0")
    settings.intra_op_num_threads = int(threads or thread_limit() or 0)
    # Falling back to the CPU after a failure, it would print blocks of text.
    session = onnxruntime.InferenceSession(model, settings, providers=[provider], enable_fallback=0)
    session.disable_fallback()
    session._model_bytes = None  # the content of the file, which it keeps for falling back
    return session
