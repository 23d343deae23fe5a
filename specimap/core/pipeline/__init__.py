"""The four stages in order, each resumable from its artefact."""

from specimap.core.pipeline.run import Inputs, Outputs, run_pipeline
from specimap.core.pipeline.settings import PipelineSettings, settings_from

__all__ = ["Inputs", "Outputs", "PipelineSettings", "run_pipeline", "settings_from"]
