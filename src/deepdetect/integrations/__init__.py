"""Drop-in replacements for parts of OpenCV, kornia, LightGlue and hloc.

Each program has its own module, which can only be imported if that program is installed.
"""
