"""Guidance: a geometry from few points, and the dense matches that it proposes and that hold."""
