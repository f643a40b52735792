"""Guided matching: a geometry from a few matches proposes dense ones, which are verified."""

from ...features.matches import GuidedMatches
from .initial_geometry import (
    InitialGeometry,
    TentativeMatches,
    find_tentative_matches,
    guiding_geometry,
)
from .pipeline import guided_matches

__all__ = [
    "GuidedMatches",
    "InitialGeometry",
    "TentativeMatches",
    "find_tentative_matches",
    "guided_matches",
    "guiding_geometry",
]
