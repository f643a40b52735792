"""Video: points followed from frame to frame, and the path of the camera."""
