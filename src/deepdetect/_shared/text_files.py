"""Small files of JSON or TOML that users write, or get from others."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any


def read_json(path: str | Path, max_bytes: int) -> Any:
    """Read a JSON file in UTF-8, with or without a byte order mark.

    Raises:
        OSError: it cannot be read.
        ValueError: it is longer than `max_bytes`, no UTF-8, no JSON, or nested too deep.
    """
    return _read(path, max_bytes, json.loads)


def read_toml(path: str | Path, max_bytes: int) -> dict[str, Any]:
    """Read a TOML file as `read_json` does; the time may grow with the square of its length."""
    return _read(path, max_bytes, tomllib.loads)


def _read(path: str | Path, max_bytes: int, parse: Callable[[str], Any]) -> Any:
    with Path(path).open("rb") as file:
        content = file.read(max_bytes + 1)
    if len(content) > max_bytes:
        raise ValueError(f"it is longer than {max_bytes} bytes")
    try:
        return parse(content.decode("utf-8-sig"))
    except RecursionError:
        raise ValueError("it is nested too deep") from None
