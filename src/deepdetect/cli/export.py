"""`deepdetect export`: files for other programs, one command for each kind."""

from __future__ import annotations

from typing import Any

import click

from .._shared.errors import BatchError, DeepDetectError
from ._generated import with_flags
from .export_matches import EXPORTS_OF_MATCHES
from .export_onnx import export_onnx

EXPORTS: tuple[click.Command, ...] = (export_onnx, *EXPORTS_OF_MATCHES)
"""To add a kind of file, write its command in a module beside this one, and add it here."""


class Exports(click.Group):
    """A group whose errors name the options of the command that was called."""

    def invoke(self, context: click.Context) -> Any:
        try:
            return super().invoke(context)
        except DeepDetectError as error:
            command = self.get_command(context, context.invoked_subcommand or "")
            error.args = (with_flags(str(error), command),)
            if isinstance(error, BatchError):
                error.failures = tuple(with_flags(each, command) for each in error.failures)
            raise


@click.group(cls=Exports, short_help="Files for other programs.")
def export() -> None:
    """Write files for other programs."""


for command in EXPORTS:
    export.add_command(command)
