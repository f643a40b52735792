"""Guided matching: a geometry from a few matches proposes dense ones, which are verified."""

from ...features.matches import GuidedMatches
from .initial_geometry import InitialGeometry
from .options import GuidedOptions
from .pipeline import guided_matches, guiding_geometry
from .sparse_matches import TentativeMatches, tentative_matches

__all__ = [
    "GuidedMatches",
    "GuidedOptions",
    "InitialGeometry",
    "TentativeMatches",
    "guided_matches",
    "guiding_geometry",
    "tentative_matches",
]
