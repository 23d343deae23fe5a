"""Hyperspectral cubes on disk: opened, mapped, calibrated to reflectance, checked."""

from specimap_core.cube.inspection import inspect
from specimap_core.cube.model import Cube, CubeFormat
from specimap_core.cube.opening import FORMATS, open_cube

__all__ = ["FORMATS", "Cube", "CubeFormat", "inspect", "open_cube"]
