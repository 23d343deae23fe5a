"""The FastAPI app, made from settings."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from anyio import CapacityLimiter
from fastapi import FastAPI
from fastapi_offline import FastAPIOffline
from starlette.middleware.cors import CORSMiddleware

from specimap_core import __version__
from specimap_infra.settings import ServiceSettings
from specimap_service import health, problems
from specimap_service.acquisitions import file_routes
from specimap_service.acquisitions import routes as acquisition_routes
from specimap_service.auth import routes as key_routes
from specimap_service.auth.keys import Keyring
from specimap_service.clouds import export_routes, label_routes, preview_routes, spectra_routes, zarr_routes
from specimap_service.clouds import routes as cloud_routes
from specimap_service.clouds.spectra import SpectraRequest
from specimap_service.context import AppContext
from specimap_service.jobs import routes as job_routes
from specimap_service.json_limit import Gate
from specimap_service.middleware import Observed
from specimap_service.uploads import form_routes
from specimap_service.uploads import routes as upload_routes

DESCRIPTION = """\
Photos and one hyperspectral cube of an excised specimen to a metric 3D point cloud in which every point carries its
spectrum. Every call but `/healthz` and `/readyz` takes a key: `Authorization: Bearer spk_…`. Errors are
`application/problem+json` with a stable code and an advice. Within `/v1` the contract only grows.
"""


def create_app(settings: ServiceSettings) -> FastAPI:
    """An app on the database and storage that the settings name; the database has been migrated.

    Raises:
        SettingsError, OutputNotWritableError: the storage or its folder cannot be made.
    """
    context = AppContext.open(settings)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        async with upload_routes.sweeping(app, context):
            yield
        context.close()

    # Its pages bring their scripts along: nothing is fetched from elsewhere.
    app = FastAPIOffline(
        title="Specimap",
        version=__version__,
        description=DESCRIPTION,
        license_info={"name": "Apache-2.0", "identifier": "Apache-2.0"},
        responses=problems.RESPONSES,
        redirect_slashes=False,
        lifespan=lifespan,
        separate_input_output_schemas=False,
    )
    app.state.context = context
    app.state.keyring = Keyring(context.database, settings.rate_per_minute, settings.quota_bytes)
    app.state.parsing = CapacityLimiter(1)
    problems.install(app)
    problems.describe(app, read_apart=[SpectraRequest])
    for module in (
        health,
        key_routes,
        acquisition_routes,
        form_routes,
        file_routes,
        upload_routes,
        job_routes,
        cloud_routes,
        zarr_routes,
        spectra_routes,
        preview_routes,
        label_routes,
        export_routes,
    ):
        app.include_router(module.router)
    # Within what answers browsers' questions and puts uploads right, before all that reads a body.
    app.add_middleware(Gate)
    upload_routes.mount(app, context)
    if settings.cors_origins:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=settings.cors_origins,
            allow_methods=["*"],
            allow_headers=["*"],
            expose_headers=EXPOSED,
            max_age=600,
        )
    app.add_middleware(Observed, metrics=context.metrics)
    return app


EXPOSED = [
    "Accept-Ranges",
    "Content-Length",
    "Content-Range",
    "ETag",
    "Location",
    "Retry-After",
    "X-Correlation-Id",
    "Tus-Resumable",
    "Tus-Version",
    "Tus-Extension",
    "Tus-Max-Size",
    "Upload-Offset",
    "Upload-Length",
    "Upload-Expires",
    "Upload-Metadata",
    "X-Specimap-Total",
    "X-Specimap-Range",
    "X-Specimap-Extent-Mm",
    "X-Specimap-Label-Version",
    "X-Specimap-Next-Offset",
    "Tus-Checksum-Algorithm",
    "Specimap-File",
    "Specimap-Verdict",
]
"""Headers that a page of another origin may read."""
