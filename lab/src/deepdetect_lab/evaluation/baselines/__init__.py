"""Detectors with their descriptors to compare with: classical, from outside, and chance."""
