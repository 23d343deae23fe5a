"""Numbers of robust statistics."""

SIGMA_OF_MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
MEDIAN_OF_RAYLEIGH = 1.1774
"""Median length of a 2D normal vector of unit standard deviation."""
