"""The laboratory of DeepDetect: data sets, labels, training, evaluation.

Users run the package `deepdetect` on images. This package trains its networks, and measures how
well they and the methods of `deepdetect` work.
"""
