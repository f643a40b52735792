"""The command line `deepdetect`: modules of commands, and the options that they share."""

from ._app import main

__all__ = ["main"]
