"""The command line `deepdetect`: its commands, some of them together in a module."""

from ._app import main

__all__ = ["main"]
