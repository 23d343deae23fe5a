"""The surface: fused, refined, its uncertainty."""
