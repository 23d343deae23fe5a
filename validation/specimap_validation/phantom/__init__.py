"""Synthetic specimens with exact truth, quick to render, for tests, validation and the sample acquisition."""

from specimap_core.truth.truth_file import Truth, load_truth, save_truth
from specimap_validation.phantom.materials import MATERIALS, endmembers
from specimap_validation.phantom.phantom import Phantom
from specimap_validation.phantom.render import Paint, Rendering, render_view
from specimap_validation.phantom.scene import Scene, build_scene
from specimap_validation.phantom.settings import PhantomSettings
from specimap_validation.phantom.write import write_cube, write_phantom

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
