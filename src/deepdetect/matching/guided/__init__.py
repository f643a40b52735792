"""Guided matching: a geometry from a few matches proposes dense ones, which are verified."""

from .pipeline import guided_matches

__all__ = ["guided_matches"]
