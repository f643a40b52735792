"""The command line `deepdetect`: one module a command."""

from ._app import main

__all__ = ["main"]
