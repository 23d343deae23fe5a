"""Hyperspectral cubes on disk: opened, mapped, calibrated to reflectance, checked."""

from specimap.core.cube.content import inspect
from specimap.core.cube.model import Cube, CubeFormat
from specimap.core.cube.opening import FORMATS, open_cube

__all__ = ["FORMATS", "Cube", "CubeFormat", "inspect", "open_cube"]
