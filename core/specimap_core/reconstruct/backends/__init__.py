"""Backends beside the pairs of photos, and what they share: weights files, and what is there of them."""
