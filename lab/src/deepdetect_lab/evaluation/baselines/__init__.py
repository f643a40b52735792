"""Detectors and descriptors as baselines: classical ones, external ones, and chance."""
