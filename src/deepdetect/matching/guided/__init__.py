"""Guided matching: a geometry from a few matches proposes dense ones, which are verified."""

from ...features.matches import GuidedMatches
from .initial_geometry import InitialMatches, initial_matches
from .options import GuidedOptions
from .pipeline import guided_matches

__all__ = ["GuidedMatches", "GuidedOptions", "InitialMatches", "guided_matches", "initial_matches"]
