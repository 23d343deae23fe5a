"""Edges and grids that cannot be are refused before depth is measured; those that can be are not."""

from __future__ import annotations

from dataclasses import replace

import pytest

from specimap_core.arrays import Floats
from specimap_core.errors import EdgeImplausibleError, SettingsError
from specimap_core.geometry.cameras import Pose
from specimap_core.pipeline.scale_check import check_scale, reach_mm
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.render.settings import RenderSettings
from tests.support.scenes import marker_scene


def scene(factor: float) -> tuple[tuple[Pose, ...], Floats]:
    """Cameras 150 mm times ``factor`` from four markers, as an edge that is wrong by ``factor`` has them."""
    truth, _ = marker_scene()
    return tuple(Pose(p.R, p.t * factor) for p in truth.poses), truth.corners * factor


def with_edge(edge_mm: float, **grids: float) -> PipelineSettings:
    usual = PipelineSettings()
    return replace(usual, adjust=replace(usual.adjust, edge_mm=edge_mm), render=RenderSettings(**grids))


def test_the_distance_is_that_to_the_markers() -> None:
    assert reach_mm(*scene(1.0)) == pytest.approx(150, rel=0.02)
    assert reach_mm(*scene(3.0)) == pytest.approx(450, rel=0.02)


@pytest.mark.parametrize("factor", [0.3, 1.0, 4.0, 15.0])
def test_usual_close_and_large_layouts_are_let_through(factor: float) -> None:
    """Cameras from 45 mm to 2.2 m; layouts from 15 to 750 mm."""
    check_scale(*scene(factor), with_edge(6.8 * factor, r_pc_mm=0.5, r_reg_mm=1.0))


@pytest.mark.parametrize(
    ("edge", "factor", "likely"),
    [
        (0.0068, 0.001, "0.0068 metres are 6.8 mm"),
        (0.68, 0.1, "0.68 centimetres are 6.8 mm"),
        (0.268, 1 / 25.4, "0.268 inches are 6.807 mm"),
        (300.0, 44.0, "give it in millimetres."),
    ],
)
def test_the_unit_that_fits_is_named(edge: float, factor: float, likely: str) -> None:
    with pytest.raises(EdgeImplausibleError) as refused:
        check_scale(*scene(factor), with_edge(edge))
    assert likely in refused.value.advice
    assert refused.value.details["distance_mm"] == pytest.approx(150 * factor, rel=0.02)


def test_exif_alone_refuses_no_edge() -> None:
    check_scale(*scene(1.0), with_edge(6.8), subject_mm=3000)
    check_scale(*scene(10.0), with_edge(68), subject_mm=400)
    with pytest.raises(EdgeImplausibleError, match="EXIF says 150 mm"):
        check_scale(*scene(10.0), with_edge(68), subject_mm=150)


@pytest.mark.parametrize(("name", "cell"), [("r_pc", 0.002), ("r_pc", 19.0), ("r_reg", 0.002), ("r_reg", 15.0)])
def test_grids_too_fine_or_too_coarse_for_the_layout(name: str, cell: float) -> None:
    with pytest.raises(SettingsError) as refused:
        check_scale(*scene(1.0), with_edge(6.8, **{f"{name}_mm": cell}))
    assert refused.value.details["setting"] == name
    assert "mm" in refused.value.advice


def test_a_single_marker_is_not_held_to_the_grids() -> None:
    poses, corners = scene(1.0)
    check_scale(poses, corners[:1], with_edge(6.8))
