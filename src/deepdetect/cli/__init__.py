"""The command line: `deepdetect detect | match | label | train | evaluate | demo`."""

from .main import main

__all__ = ["main"]
