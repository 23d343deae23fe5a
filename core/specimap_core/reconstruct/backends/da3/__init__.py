"""Depth Anything 3 (Lin et al. 2025): depth by a network, poses by markers, scale by what is known in millimetres."""
