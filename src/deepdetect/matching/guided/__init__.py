"""Guided matching: a geometry from a few matches proposes dense ones, which are verified."""

from ...features.matches import GuidedMatches
from .options import GuidedOptions
from .pipeline import guided_matches
from .sparse_matches import InitialMatches, initial_matches

__all__ = ["GuidedMatches", "GuidedOptions", "InitialMatches", "guided_matches", "initial_matches"]
