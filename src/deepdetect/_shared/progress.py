"""The progress bar of long tasks."""

from __future__ import annotations

import sys
from typing import Any


def progress(total: int, title: str, unit: str, quiet: bool = False, done: int = 0) -> Any:
    """Return a progress bar on standard error.

    Args:
        total: number of units.
        title: the word before the bar.
        unit: name of one unit, such as "image".
        quiet: show nothing.
        done: units that were done earlier.

    Returns:
        A tqdm bar: a context manager with `update(n)` and `set_postfix_str(text)`.
    """
    from tqdm import tqdm

    return tqdm(
        total=total,
        initial=done,
        desc=title,
        unit=unit,
        disable=quiet or total == 0,
        file=sys.stderr,
        dynamic_ncols=True,
        mininterval=0.2 if sys.stderr.isatty() else 10,
    )
