"""Published descriptor networks, read at our points, for the training of our own descriptor."""
