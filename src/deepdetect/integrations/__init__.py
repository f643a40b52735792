"""Drop-in replacements for parts of OpenCV, kornia, LightGlue and hloc.

Importing one of these modules raises a MissingExtraError if a package that it needs is missing.
"""
