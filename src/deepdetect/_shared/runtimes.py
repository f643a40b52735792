"""Import of ONNX Runtime and OpenVINO without telemetry, and sessions of ONNX Runtime."""

from __future__ import annotations

import importlib
import os
import sys
import threading
from collections.abc import MutableMapping
from types import ModuleType
from typing import Any

from .machine import thread_limit

CPU, CUDA = "CPUExecutionProvider", "CUDAExecutionProvider"

_import_lock = threading.Lock()


def import_onnxruntime() -> ModuleType:
    """Import ONNX Runtime with ORT_DISABLE_TELEMETRY=1, unless the user has set this variable."""
    # The variable is read during the import; disable_telemetry_events() would come too late.
    variable = "ORT_DISABLE_TELEMETRY"
    return _import_with("onnxruntime", os.environ, variable, os.environ.get(variable, "1"))


def import_openvino() -> ModuleType:
    """Import OpenVINO as if the optional openvino_telemetry were not installed."""
    # The environment variable CI would disable telemetry, but also affects other packages.
    return _import_with("openvino", sys.modules, "openvino_telemetry", None)


def _import_with(
    package: str, entries: MutableMapping[str, Any], key: str, value: object
) -> ModuleType:
    """Import a package while `entries[key]` is `value`, and then restore the entry.

    ONNX Runtime and OpenVINO start telemetry when they are imported: they write an identifier into
    the home folder, and OpenVINO sends an event.
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
    """Start a session of ONNX Runtime that prints nothing; `model` is a file or its contents."""
    onnxruntime = import_onnxruntime()
    settings = onnxruntime.SessionOptions()
    settings.log_severity_level = 4  # no messages, because errors also raise exceptions
    settings.enable_cpu_mem_arena = settings.enable_mem_pattern = keep_memory
    # Waiting threads that spin start work sooner, but occupy processors long after a run.
    settings.add_session_config_entry("session.intra_op.allow_spinning", "0")
    settings.intra_op_num_threads = int(threads or thread_limit() or 0)
    # Falling back to the CPU after a failure, as by default, would print blocks of text.
    # By default, CUDA rounds the factors of products to 10 bits (TF32), which moves keypoints.
    how = {"use_tf32": "0"} if provider == CUDA else {}
    session = onnxruntime.InferenceSession(
        model, settings, providers=[(provider, how)], enable_fallback=0
    )
    session.disable_fallback()
    session._model_bytes = None  # frees the file's contents, kept for a fallback
    return session
