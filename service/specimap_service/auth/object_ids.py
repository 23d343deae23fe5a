"""Ids in addresses. A route that declares one gets it only if its key may touch the object.

Every id in the path of a route is declared by one of these types: `tests/service/test_access.py` fails for any other.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Annotated

from fastapi import Depends, Path
from fastapi.concurrency import run_in_threadpool

from specimap_service.auth.dependencies import AccessDep, Known
from specimap_service.auth.keys import Principal


async def _check(access: AccessDep, principal: Principal, object_id: str) -> str:
    # A thread costs as much as the rest of a short request, so it is taken only to ask the database.
    if not access.is_known(principal, object_id):
        await run_in_threadpool(access.check, principal, object_id)
    return object_id


def _path(kind: str) -> object:
    return Path(pattern=rf"^{kind}_[0-9a-z]{{26}}$", examples=[f"{kind}_01k00000000000000000000000"])


async def visible_acquisition(access: AccessDep, principal: Known, acquisition_id: Annotated[str, _path("acq")]) -> str:
    """Return the id. Raises NotFoundError unless the key may touch the acquisition; so do the others."""
    return await _check(access, principal, acquisition_id)


async def visible_upload(access: AccessDep, principal: Known, upload_id: Annotated[str, _path("up")]) -> str:
    """Return the id of an upload."""
    return await _check(access, principal, upload_id)


async def visible_job(access: AccessDep, principal: Known, job_id: Annotated[str, _path("job")]) -> str:
    """Return the id of a job."""
    return await _check(access, principal, job_id)


async def visible_cloud(access: AccessDep, principal: Known, cloud_id: Annotated[str, _path("cloud")]) -> str:
    """Return the id of a cloud."""
    return await _check(access, principal, cloud_id)


async def visible_key(access: AccessDep, principal: Known, key_id: Annotated[str, _path("key")]) -> str:
    """Return the id of a key."""
    return await _check(access, principal, key_id)


async def visible_project(access: AccessDep, principal: Known, project_id: Annotated[str, _path("prj")]) -> str:
    """Return the id of a project."""
    return await _check(access, principal, project_id)


async def visible_share(access: AccessDep, principal: Known, share_id: Annotated[str, _path("shr")]) -> str:
    """Return the id of a share."""
    return await _check(access, principal, share_id)


AcquisitionId = Annotated[str, Depends(visible_acquisition)]
UploadId = Annotated[str, Depends(visible_upload)]
JobId = Annotated[str, Depends(visible_job)]
CloudId = Annotated[str, Depends(visible_cloud)]
KeyId = Annotated[str, Depends(visible_key)]
ProjectId = Annotated[str, Depends(visible_project)]
ShareId = Annotated[str, Depends(visible_share)]
GUARDS: dict[str, Callable[..., Awaitable[str]]] = {
    "acquisition_id": visible_acquisition,
    "upload_id": visible_upload,
    "job_id": visible_job,
    "cloud_id": visible_cloud,
    "key_id": visible_key,
    "project_id": visible_project,
    "share_id": visible_share,
}
"""By the name that an id has in addresses."""
