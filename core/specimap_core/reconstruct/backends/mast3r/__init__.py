"""MASt3R-SfM (Duisterhof et al. 2024) as a backend: a checkout and weights that the user brings."""
