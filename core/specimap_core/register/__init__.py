"""Stage 4: the cube onto the surface."""
