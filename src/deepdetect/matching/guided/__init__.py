"""Guided matching: a geometry from a few matches proposes dense matches, which are verified."""

from .initial_geometry import guiding_geometry
from .pipeline import guided_matches
from .tentative_matches import TentativeMatches, find_tentative_matches

__all__ = ["TentativeMatches", "find_tentative_matches", "guided_matches", "guiding_geometry"]
