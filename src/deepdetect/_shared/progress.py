"""The progress bar of long tasks."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any


def progress(total: int | None, title: str, unit: str, quiet: bool = False, done: int = 0) -> Any:
    """Return a progress bar on standard error.

    Args:
        total: number of units; None where it is not known.
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


@contextmanager
def stage_progress(title: str, stages: Sequence[str]) -> Iterator[Callable[[str], None]]:
    """Show a bar of the stages of a task on a terminal, with the name of the one under way.

    Args:
        title: the word before the bar.
        stages: in their order.

    Yields:
        A function to be called with the name of each stage when it ends.
    """
    # On a terminal only: what is logged stays readable.
    with progress(len(stages), title, "stage", quiet=not sys.stderr.isatty()) as bar:
        bar.set_postfix_str(stages[0])

        def done(stage: str) -> None:
            bar.update()
            bar.set_postfix_str(stages[bar.n] if bar.n < len(stages) else "")

        yield done


def say(text: str) -> None:
    """Write a line to standard error, above a bar where there is one."""
    from tqdm import tqdm

    tqdm.write(text, file=sys.stderr)
