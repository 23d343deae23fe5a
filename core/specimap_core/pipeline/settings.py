"""All knobs of a run, grouped by stage; the published values are the defaults."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import cast

from specimap_core.bundle_adjust.adjust import AdjustSettings
from specimap_core.fiducials.detection import dictionary_named
from specimap_core.photos.reading import AcquisitionSettings
from specimap_core.pipeline.options import Backend, RunOptions, check_choice, check_number
from specimap_core.reconstruct.backend import ReconstructSettings
from specimap_core.reconstruct.dense.device import DEVICES, Device
from specimap_core.reconstruct.dense.settings import DepthSettings
from specimap_core.register.settings import RegisterSettings
from specimap_core.render.settings import RenderSettings
from specimap_core.surface.settings import RefineSettings, SurfaceSettings

WITH_OWN_CAMERAS = ("mast3r",)
"""Backends that find cameras without the markers."""
VOXEL_MM = (0.005, 50.0)
"""Least and largest edge of a fusion voxel."""


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
        self.options.check()
        if self.surface.voxel_mm is not None:
            check_number("voxel_mm", self.surface.voxel_mm, VOXEL_MM)
        check_choice("device", self.reconstruct.depth.device, DEVICES)

    @property
    def options(self) -> RunOptions:
        """The choices of a person that these settings hold."""
        return RunOptions(
            edge_mm=self.adjust.edge_mm,
            dictionary=self.reconstruct.dictionary,
            r_reg=self.render.r_reg_mm,
            r_pc=self.render.r_pc_mm,
            working_px=self.acquisition.working_px,
            backend=cast(Backend, self.reconstruct.backend),
            features=self.reconstruct.features,
            method=self.register.method,
            adjustment=self.adjust.form,
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


def settings_from(options: RunOptions, device: Device = "auto") -> PipelineSettings:
    """Settings of a run from what a person chooses and the ``device`` that its keys hold; checked.

    Raises:
        SettingsError, UnknownDictionaryError: see :meth:`PipelineSettings.check`.
    """
    settings = PipelineSettings(
        acquisition=AcquisitionSettings(working_px=options.working_px),
        reconstruct=ReconstructSettings(
            dictionary=options.dictionary,
            edge_mm=options.edge_mm,
            backend=options.backend,
            features=options.features,
            depth=DepthSettings(device=device),
        ),
        adjust=AdjustSettings(form=options.adjustment, edge_mm=options.edge_mm),
        render=RenderSettings(r_reg_mm=options.r_reg, r_pc_mm=options.r_pc),
        register=RegisterSettings(method=options.method),
    )
    settings.check()
    return settings
