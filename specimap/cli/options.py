"""Command line options to the stages' settings."""

from __future__ import annotations

from typing import cast

from specimap.core.acquisition import AcquisitionSettings
from specimap.core.adjust import AdjustSettings, Form
from specimap.core.pipeline import PipelineSettings
from specimap.core.reconstruct.backend import ReconstructSettings
from specimap.core.register.register import Method, RegisterSettings
from specimap.core.render import RenderSettings


def settings_from(
    *,
    edge_mm: float,
    dictionary: str,
    method: str,
    adjustment: str,
    r_pc: float,
    r_reg: float,
    backend: str,
    working_px: int,
) -> PipelineSettings:
    """Settings of a run, checked.

    Raises:
        SettingsError, UnknownDictionaryError: see :meth:`PipelineSettings.check`.
    """
    settings = PipelineSettings(
        acquisition=AcquisitionSettings(working_px=working_px),
        reconstruct=ReconstructSettings(dictionary=dictionary, edge_mm=edge_mm, backend=backend),
        adjust=AdjustSettings(form=cast(Form, adjustment), edge_mm=edge_mm),
        render=RenderSettings(r_reg_mm=r_reg, r_pc_mm=r_pc),
        register=RegisterSettings(method=cast(Method, method)),
    )
    settings.check()
    return settings
