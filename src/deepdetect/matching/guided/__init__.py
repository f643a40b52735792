"""Guidance: a geometry from few points, and the dense matches that it proposes and that hold."""

from .pipeline import GUIDANCES, Guidance, guided_matches

__all__ = ["GUIDANCES", "Guidance", "guided_matches"]
