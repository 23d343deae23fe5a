"""Health checks: ``/healthz`` (the process answers), ``/readyz`` (it can serve requests), ``/metrics`` (with a key)."""

from __future__ import annotations

from typing import Annotated

import sqlalchemy as sa
from fastapi import APIRouter, Response
from pydantic import BaseModel, Field

from specimap_core import __version__
from specimap_infra.database import database_seconds
from specimap_infra.tables import Lease
from specimap_service.auth.dependencies import Permitted
from specimap_service.context import Context

router = APIRouter(tags=["health"])


class Health(BaseModel):
    """The process answers."""

    status: Annotated[str, Field(examples=["ok"])]
    version: str


class Readiness(BaseModel):
    """Database and storage answer; ``workers`` counts those whose heartbeat is fresh."""

    status: Annotated[str, Field(examples=["ready"])]
    workers: int


@router.get("/healthz", operation_id="health.get")
async def healthz() -> Health:
    """Check that the process answers; neither database nor storage is asked."""
    return Health(status="ok", version=__version__)


@router.get("/readyz", operation_id="health.get_readiness")
def readyz(context: Context) -> Readiness:
    """Check that requests can be served: 503 with a code where the database or the storage does not answer."""
    with context.database.session() as session:
        oldest = database_seconds(context.database.engine) - context.settings.lease_seconds
        workers = session.scalar(sa.select(sa.func.count()).where(Lease.heartbeat >= oldest)) or 0
    context.storage.check()
    return Readiness(status="ready", workers=workers)


@router.get(
    "/metrics",
    response_class=Response,
    responses={200: {"content": {"text/plain": {}}}},
    operation_id="health.get_metrics",
)
def metrics(context: Context, principal: Permitted) -> Response:
    """Return the metrics in Prometheus' text format."""
    return Response(context.metrics.text(), media_type="text/plain; version=0.0.4; charset=utf-8")
