"""Pixels in, measurements out: the only rooms that know OpenCV besides reading and writing files."""
