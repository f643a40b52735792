"""Drop-in replacements for parts of OpenCV, kornia, LightGlue and hloc.

Importing a module raises a MissingExtraError if a package that it needs is not installed.
"""
