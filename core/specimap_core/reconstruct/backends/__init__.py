"""The reconstruction backends, and what they share: weights files, settings, alignment to the markers."""
