"""Guided matching: a geometry from a few matches proposes dense ones, which are verified."""

from .initial_geometry import InitialMatches, initial_matches
from .options import GuidedOptions
from .pipeline import GuidedMatches, guided_matches

__all__ = ["GuidedMatches", "GuidedOptions", "InitialMatches", "guided_matches", "initial_matches"]
