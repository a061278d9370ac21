"""Structure from motion: cameras of a video whose camera is not known, and the pixels that move in it."""
