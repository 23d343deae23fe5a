"""ArUco markers: found, located to a fraction of a pixel, laid out in space."""
