"""Cameras, projection and robust statistics."""
