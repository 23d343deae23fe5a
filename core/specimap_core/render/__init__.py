"""Stage 3: orthographic grids of the surface."""
