"""Depth of every photo, from pairs of photos."""
