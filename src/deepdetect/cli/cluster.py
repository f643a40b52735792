"""How one of several training processes ends."""

from __future__ import annotations

import contextlib
import os
import sys
import traceback
from collections.abc import Iterator

import click

from .._shared.errors import DeepDetectError


@contextlib.contextmanager
def ending_all_processes() -> Iterator[None]:
    """End one of several processes at once, when all is written, or after an error.

    Then torchrun ends the others. The usual way out would first wait for them, which wait
    for this one; and Python's own end can meet gloo's threads, and hang with them
    (pytorch#190489). A process alone goes the usual way.
    """
    from ..training.cluster import distributed_context

    status = 0
    try:
        yield
    except BaseException as error:
        if distributed_context().processes == 1:
            raise
        if isinstance(error, DeepDetectError):
            click.echo(f"deepdetect: {error}", err=True)
            status = 2
        else:
            traceback.print_exc()
            status = 130 if isinstance(error, KeyboardInterrupt) else 1
    if distributed_context().processes > 1:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
