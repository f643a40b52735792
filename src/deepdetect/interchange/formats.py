"""The formats of other programs.

To add one, write a function `(collection, output, ...) -> files` in a module of its own, and a line
here; its command is a function of `cli/export_matches.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from .._shared.registry import look_up
from .bundler import write_bundler
from .colmap import write_colmap, write_colmap_text
from .hloc import write_hloc
from .opencv import write_opencv

Writer = Callable[..., tuple[Path, ...]]

FORMATS: dict[str, Writer] = {
    "colmap": write_colmap,
    "colmap-text": write_colmap_text,
    "hloc": write_hloc,
    "opencv": write_opencv,
    "bundler": write_bundler,
}


def get_format(name: str) -> Writer:
    """Return what writes a format.

    Raises:
        OptionError: the name is unknown.

    Example:
        >>> get_format("hloc").__name__
        'write_hloc'
    """
    return look_up("format", name, FORMATS)
