"""DeepDetect as a part of OpenCV, kornia, LightGlue, hloc.

One module for each program, which is the only one that imports it; it cannot be imported without.
"""
