"""The command line `deepdetect`: its commands, grouped in modules, and their options."""

from ._app import main

__all__ = ["main"]
