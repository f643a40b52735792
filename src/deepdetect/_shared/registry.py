"""Look-ups in registries: plain mappings from a name to an entry."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

from .errors import unknown_name

Entry = TypeVar("Entry")


def look_up(kind: str, name: str, registry: Mapping[str, Entry]) -> Entry:
    """Return the entry of this name; `kind` says what the entries are, as "matcher".

    Raises:
        OptionError: the name is unknown (the nearest right one is named).
    """
    if name not in registry:
        raise unknown_name(kind, name, registry)
    return registry[name]


def resolve_name_or_path(
    kind: str, value: str | Path, registry: Mapping[str, Entry]
) -> Entry | Path:
    """Return the path that was given, or the entry of a registry whose name was given.

    Raises:
        OptionError: it is neither a path nor a known name (the nearest right one is named).
    """
    if is_path(value):
        return Path(value)
    if value not in registry:
        raise unknown_name(kind, value, (*registry, "or the path of a file"))
    return registry[str(value)]


def is_path(value: str | Path) -> bool:
    """Return whether a value is a path, not a name: it has a suffix or a separator.

    Example:
        >>> [is_path(text) for text in ("dense", "dense.onnx", "./dense")]
        [False, True, True]
    """
    text = str(value)
    return bool(Path(text).suffix) or any(mark in text for mark in (os.sep, os.altsep) if mark)
