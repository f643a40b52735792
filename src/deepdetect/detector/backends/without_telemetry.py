"""Imports of ONNX Runtime and OpenVINO that start no telemetry.

Both start it when they are imported: they write an identifier into the home folder, and OpenVINO
sends an event. A package that was imported before is left as it is.
"""

from __future__ import annotations

import importlib
import os
import sys
import threading
from collections.abc import MutableMapping
from types import ModuleType
from typing import Any

_lock = threading.Lock()


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
    """Import a package while an entry has a value; then put back what was there."""
    with _lock:
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
