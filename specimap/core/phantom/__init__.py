"""Synthetic specimens with exact truth, quick to render, for tests, validation and the sample acquisition."""

from specimap.core.phantom.materials import MATERIALS, endmembers
from specimap.core.phantom.phantom import Phantom
from specimap.core.phantom.render import Paint, Rendering, render_view
from specimap.core.phantom.scene import Scene, build_scene
from specimap.core.phantom.settings import PhantomSettings
from specimap.core.phantom.truth import Truth, load_truth, save_truth
from specimap.core.phantom.write import write_cube, write_phantom

__all__ = [
    "MATERIALS",
    "Paint",
    "Phantom",
    "PhantomSettings",
    "Rendering",
    "Scene",
    "Truth",
    "build_scene",
    "endmembers",
    "load_truth",
    "render_view",
    "save_truth",
    "write_cube",
    "write_phantom",
]
