"""The FastAPI app, made from settings."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path

from anyio import to_thread
from fastapi import Depends, FastAPI
from fastapi_offline import FastAPIOffline
from starlette.middleware.cors import CORSMiddleware

from specimap_core import __version__
from specimap_infra.settings import ServiceSettings
from specimap_service import health, problems
from specimap_service.acquisitions import dependencies as acquisitions
from specimap_service.acquisitions import erasure_routes, file_routes, hold_routes, viewpoint_routes
from specimap_service.acquisitions import routes as acquisition_routes
from specimap_service.auth import audit_routes, project_routes, session_routes, sso_routes
from specimap_service.auth import dependencies as auth
from specimap_service.auth import routes as key_routes
from specimap_service.body_limits import BodyLimits
from specimap_service.clouds import dependencies as clouds
from specimap_service.clouds import (
    export_routes,
    label_routes,
    preview_routes,
    share_routes,
    spectra_routes,
    zarr_routes,
)
from specimap_service.clouds import routes as cloud_routes
from specimap_service.clouds.spectra_schemas import SpectraRequest
from specimap_service.compression import Compression
from specimap_service.context import CONTEXT, AppContext
from specimap_service.contract.description import describe
from specimap_service.head_requests import HeadRequests
from specimap_service.hospital import dependencies as hospital
from specimap_service.hospital import dicom_routes, fhir_routes, order_routes, stow_routes, study_routes
from specimap_service.jobs import delivery_routes
from specimap_service.jobs import dependencies as jobs
from specimap_service.jobs import routes as job_routes
from specimap_service.jobs.schemas import EVENT_TYPES
from specimap_service.middleware import RequestObserver
from specimap_service.page_files import FOLDER, Pages
from specimap_service.query_parameters import check_query
from specimap_service.uploads import dependencies as uploads
from specimap_service.uploads import form_routes, tus_routes
from specimap_service.uploads import routes as upload_routes

DESCRIPTION = """\
Photos and one hyperspectral cube of an excised specimen to a metric 3D point cloud in which every point carries its
spectrum. Every call but `/healthz` and `/readyz` takes a key: `Authorization: Bearer spk_…`; on the service's own pages
a person signs in with one instead, or, where the service has an identity provider, with a hospital account. Errors are
`application/problem+json` with a stable code and advice. HEAD works wherever GET does. A query parameter that an
operation does not know is refused. Within `/v1` the contract only grows.
"""

FEATURES = (auth.FEATURE, acquisitions.FEATURE, uploads.FEATURE, jobs.FEATURE, clouds.FEATURE, hospital.FEATURE)
"""Opened in this order, closed in the reverse one: uploads use the judge of acquisitions."""
ROUTES = (
    health,
    project_routes,
    key_routes,
    audit_routes,
    session_routes,
    sso_routes,
    acquisition_routes,
    form_routes,
    file_routes,
    viewpoint_routes,
    hold_routes,
    erasure_routes,
    upload_routes,
    job_routes,
    delivery_routes,
    cloud_routes,
    zarr_routes,
    spectra_routes,
    preview_routes,
    label_routes,
    export_routes,
    share_routes,
    study_routes,
    order_routes,
    dicom_routes,
    fhir_routes,
    stow_routes,
)
"""Modules with a ``router``, in the order of the API's description."""


def create_app(settings: ServiceSettings, pages: Path = FOLDER) -> FastAPI:
    """Create an app on the database and storage that the settings name; the database has been migrated.

    ``pages``: the folder of the built web pages.

    Raises:
        SettingsError, OutputNotWritableError: the storage or its folder cannot be made.
    """
    context = AppContext.open(settings)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        async with AsyncExitStack() as stack:
            stack.callback(context.close)
            context.trail.start()
            # Everything that is still answered is in it.
            stack.push_async_callback(to_thread.run_sync, context.trail.stop)
            for feature in FEATURES:
                await stack.enter_async_context(feature.running(app))
            yield

    # The offline variant serves the scripts of its pages itself: nothing is fetched from elsewhere.
    app = FastAPIOffline(
        title="Specimap",
        version=__version__,
        description=DESCRIPTION,
        license_info={"name": "Apache-2.0", "identifier": "Apache-2.0"},
        responses=problems.RESPONSES,
        servers=[{"url": "/", "description": "The service that this document comes from."}],
        dependencies=[Depends(check_query)],
        redirect_slashes=False,
        lifespan=lifespan,
        separate_input_output_schemas=False,
    )
    CONTEXT.set(app, context)
    for feature in FEATURES:
        feature.open(app, context)
    problems.add_handlers(app)
    describe(app, extra_models=[SpectraRequest, *EVENT_TYPES.values()])
    for routes in ROUTES:
        app.include_router(routes.router)
    app.router.routes.append(Pages(pages))
    # The last one added sees a request first: the limits come after CORS and the corrections of uploads, and before
    # everything that reads a body.
    app.add_middleware(Compression)
    app.add_middleware(HeadRequests)
    app.add_middleware(BodyLimits)
    tus_routes.mount(app)
    if settings.cors_origins:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=settings.cors_origins,
            allow_methods=["*"],
            allow_headers=["*"],
            expose_headers=EXPOSED,
            max_age=600,
        )
    app.add_middleware(RequestObserver, metrics=context.metrics, trail=context.trail, public_url=settings.public_url)
    return app


EXPOSED = [
    "Accept-Ranges",
    "Content-Length",
    "Content-Range",
    "ETag",
    "Link",
    "Location",
    "RateLimit",
    "RateLimit-Policy",
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
