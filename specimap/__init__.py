"""Specimap: photos and one hyperspectral cube of an excised specimen to a metric spectral point cloud."""

from importlib.metadata import version

__version__ = version("specimap")
