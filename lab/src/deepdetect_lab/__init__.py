"""The laboratory of DeepDetect: data sets, labels, training, evaluation.

`deepdetect` is what users run on images; this makes its weights, and measures both.
"""
