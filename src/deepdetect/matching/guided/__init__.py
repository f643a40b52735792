"""Guided matching: a geometry from a few matches proposes dense ones, which are verified."""

from ...features.matches import GuidedMatches
from .initial_geometry import InitialGeometry
from .pipeline import guided_matches, guiding_geometry
from .tentative_matches import TentativeMatches, find_tentative_matches

__all__ = [
    "GuidedMatches",
    "InitialGeometry",
    "TentativeMatches",
    "find_tentative_matches",
    "guided_matches",
    "guiding_geometry",
]
