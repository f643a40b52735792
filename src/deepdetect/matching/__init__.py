"""Matching two images, and what follows from it: registration, panoramas."""
