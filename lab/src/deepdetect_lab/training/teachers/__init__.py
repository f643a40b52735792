"""Published descriptor networks, evaluated at our keypoints, as teachers of our own descriptor."""
