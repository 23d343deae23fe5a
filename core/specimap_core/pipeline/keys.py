"""The key of each stage's artefact: a hash of everything that goes into it, the stages before included."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict

from specimap_core.json_text import json_text
from specimap_core.pipeline.artefact_store import key_of
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.reconstruct.backends.environment import UNCONFIGURED, BackendSettings, backend_identity


def surface_keys(
    photos: Mapping[str, str], settings: PipelineSettings, backends: BackendSettings = UNCONFIGURED
) -> dict[str, str]:
    """Keys of the stages that the cube has no part in; ``photos``: names with the hashes of the files.

    A backend with a network adds its settings and the hash of its weights, so it is to be called where these are.

    Raises:
        BackendUnavailableError: that backend's code or weights are not there.
    """
    identity = backend_identity(settings.reconstruct.backend, backends)
    reconstruct = key_of(
        "reconstruct",
        {
            "photos": dict(photos),
            "acquisition": asdict(settings.acquisition),
            "s": asdict(settings.for_stage1()),
            **({"backend": identity} if identity else {}),
        },
    )
    adjust = key_of(
        "adjust",
        {
            "before": reconstruct,
            "s": asdict(settings.adjust),
            "surface": asdict(settings.surface),
            "refine": asdict(settings.refine),
        },
    )
    render = key_of("render", {"before": adjust, "s": asdict(settings.render)})
    return {"reconstruct": reconstruct, "adjust": adjust, "render": render}


def register_key(render: str, cube: str, settings: PipelineSettings) -> str:
    """Key of stage 4; ``cube``: a hash of the cube and its references."""
    return key_of("register", {"before": render, "cube": cube, "s": asdict(settings.register)})


def digest_of(photos: Mapping[str, str]) -> str:
    """One hash for all photos."""
    return hashlib.sha256(json_text(dict(photos), sort_keys=True).encode()).hexdigest()
