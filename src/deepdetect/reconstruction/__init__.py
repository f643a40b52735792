"""Two images in, points in space out: calibration, pose, triangulation, what is wrong."""
