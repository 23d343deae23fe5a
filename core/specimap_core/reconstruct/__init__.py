"""Stage 1: cameras, lens and depth from photos."""
