"""Baselines to compare with: classical and external detectors and descriptors, and chance."""
