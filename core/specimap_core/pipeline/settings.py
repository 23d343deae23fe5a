"""All knobs of a run, grouped by stage; the published values are the defaults."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import cast

from specimap_core.bundle_adjust.adjust import AdjustSettings, Form
from specimap_core.errors import SettingsError
from specimap_core.fiducials.detection import dictionary_named
from specimap_core.photos.reading import AcquisitionSettings
from specimap_core.pipeline.limits import RANGES, advice_on
from specimap_core.reconstruct.backend import FeatureChoice, ReconstructSettings
from specimap_core.reconstruct.dense.depth_map import DepthSettings, Device
from specimap_core.reconstruct.dense.device import DEVICES, dense_device
from specimap_core.register.placement import Method, RegisterSettings
from specimap_core.render.orthographic import RenderSettings
from specimap_core.surface.fusion import SurfaceSettings
from specimap_core.surface.refinement import RefineSettings

BACKENDS = ("colmap", "mast3r", "da3")
WITH_OWN_CAMERAS = ("mast3r",)
"""Backends that find cameras without the markers."""
FEATURES = ("auto", "sift", "aliked")


@dataclass(frozen=True)
class PipelineSettings:
    """Settings of the four stages."""

    acquisition: AcquisitionSettings = field(default_factory=AcquisitionSettings)
    reconstruct: ReconstructSettings = field(default_factory=ReconstructSettings)
    adjust: AdjustSettings = field(default_factory=AdjustSettings)
    surface: SurfaceSettings = field(default_factory=SurfaceSettings)
    refine: RefineSettings = field(default_factory=RefineSettings)
    render: RenderSettings = field(default_factory=RenderSettings)
    register: RegisterSettings = field(default_factory=RegisterSettings)

    def check(self) -> None:
        """Refuse values that cannot work, before anything is read.

        Raises:
            SettingsError: a value is out of its range; details name it.
            UnknownDictionaryError: there is no such marker dictionary.
        """
        dictionary_named(self.reconstruct.dictionary)
        numbers: dict[str, float | None] = {
            "edge_mm": self.adjust.edge_mm,
            "r_reg": self.render.r_reg_mm,
            "r_pc": self.render.r_pc_mm,
            "working_px": self.acquisition.working_px,
            "voxel_mm": self.surface.voxel_mm,
        }
        for name, value in numbers.items():
            low, high = RANGES[name]
            if value is not None and not low <= value <= high:
                raise SettingsError(
                    f"{name} is {value:g}; it must be from {low:g} to {high:g}.",
                    advice=advice_on(name, value),
                    setting=name,
                )
        choices = {
            "backend": (self.reconstruct.backend, BACKENDS),
            "features": (self.reconstruct.features, FEATURES),
            "device": (self.reconstruct.depth.device, DEVICES),
            "method": (self.register.method, ("camera", "homography")),
            "adjustment": (self.adjust.form, ("rigid", "free")),
        }
        for name, (chosen, known) in choices.items():
            if chosen not in known:
                raise SettingsError(
                    f"There is no {name} {chosen!r}.", advice=f"Choose one of: {', '.join(known)}.", setting=name
                )

    def for_stage1(self) -> ReconstructSettings:
        """Stage 1's settings with what stage 2's say to it: the edge, and for whom the cameras are.

        The published adjustment takes cameras as the backend found them, depth along with them; for backends whose
        cameras are the markers' own it changes nothing in stage 1.
        """
        as_found = self.adjust.form == "free" and self.reconstruct.backend in WITH_OWN_CAMERAS
        return replace(self.reconstruct, edge_mm=self.adjust.edge_mm, hold_to_markers=not as_found)

    def as_dict(self) -> dict[str, object]:
        """JSON-ready, with stage 1's as it takes them."""
        return asdict(replace(self, reconstruct=self.for_stage1()))


def settings_from(
    *,
    edge_mm: float,
    dictionary: str,
    method: str,
    adjustment: str,
    r_pc: float,
    r_reg: float,
    backend: str,
    features: str,
    working_px: int,
) -> PipelineSettings:
    """Settings of a run from the few that a person chooses, checked; the environment names the device for dense stereo.

    Raises:
        SettingsError, UnknownDictionaryError: see :meth:`PipelineSettings.check`.
    """
    settings = PipelineSettings(
        acquisition=AcquisitionSettings(working_px=working_px),
        reconstruct=ReconstructSettings(
            dictionary=dictionary,
            edge_mm=edge_mm,
            backend=backend,
            features=cast(FeatureChoice, features),
            depth=DepthSettings(device=cast(Device, dense_device())),
        ),
        adjust=AdjustSettings(form=cast(Form, adjustment), edge_mm=edge_mm),
        render=RenderSettings(r_reg_mm=r_reg, r_pc_mm=r_pc),
        register=RegisterSettings(method=cast(Method, method)),
    )
    settings.check()
    return settings
