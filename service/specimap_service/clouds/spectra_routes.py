"""Spectra of points, selected by number, position or pixel; and single bands of all points."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Depends, Path, Query, Request
from starlette.responses import Response

from specimap_core.arrays import Array
from specimap_core.cloud import Cloud
from specimap_core.errors import NotFoundError
from specimap_core.json_text import json_text
from specimap_service.array_responses import (
    ARROW,
    JSON,
    NPY,
    arrow_answer,
    chosen_type,
    documented_responses,
    json_answer,
    npy_answer,
)
from specimap_service.auth.dependencies import Reader
from specimap_service.auth.object_ids import CloudId
from specimap_service.body_limits import parsed
from specimap_service.byte_ranges import CACHED, known_to_client
from specimap_service.clouds.dependencies import CloudsDep, ParsingDep
from specimap_service.clouds.open_clouds import CloudRecord
from specimap_service.clouds.spectra import (
    JSON_PAGE,
    MOST_JSON_POINTS,
    PAGE,
    BandAnswer,
    Point,
    SpectraAnswer,
    SpectraRequest,
    band_numbers,
    columns_of,
    field_values,
    flag_names,
    listed_bands,
    selected,
)

router = APIRouter(prefix="/v1", tags=["spectra"])
BandList = Annotated[
    str | None,
    Query(pattern=r"^\d{1,5}(-\d{1,5})?(,\d{1,5}(-\d{1,5})?)*$", max_length=2000, description="As in `0,5,10-20`."),
]
Number = Annotated[int, Path(ge=0, lt=2**32)]


@router.get("/clouds/{cloud_id}/points/{index}", response_model=Point)
def show_point(
    principal: Reader, clouds: CloudsDep, cloud_id: CloudId, index: Number, bands: BandList = None
) -> Response:
    """Return one point: position, colour, flags, labels, spectrum."""
    with clouds.reading(cloud_id) as (record, cloud):
        if index >= cloud.n_points:
            raise NotFoundError(
                f"There is no point {index}: the cloud has {cloud.n_points}.",
                advice=f"Points count from 0 to {cloud.n_points - 1}.",
            )
        numbers = band_numbers(cloud, listed_bands(bands))
        flags = int(cloud.flags[index])
        return json_answer(
            {
                "index": index,
                "xyz": cloud.xyz[index],
                "normal": cloud.normal[index],
                "rgb": cloud.rgb[index],
                "hsi_pixel": cloud.hsi_pixel[index],
                "sigma_mm": float(cloud.sigma_mm[index]),
                "flags": flags,
                "flag_names": flag_names(flags),
                "labels": {
                    name: clouds.label_array(label).read(index, index + 1)[0] for name, label in record.labels.items()
                },
                **_described(cloud, numbers),
                "spectrum": cloud.spectra([index], numbers)[0],
            }
        )


BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {JSON: {"schema": {"$ref": "#/components/schemas/SpectraRequest"}}},
    }
}


async def _wanted(request: Request, limiter: ParsingDep) -> SpectraRequest:
    return await parsed(request, SpectraRequest, limiter)


@router.post(
    "/clouds/{cloud_id}/spectra",
    response_model=SpectraAnswer,
    responses=documented_responses(SpectraAnswer),
    openapi_extra=BODY,
)
def read_spectra(
    principal: Reader,
    clouds: CloudsDep,
    request: Request,
    cloud_id: CloudId,
    wanted: Annotated[SpectraRequest, Depends(_wanted)],
) -> Response:
    """Return spectra of the selected points, a page at a time.

    Arrow: columns `index`, the requested fields, `spectrum`; total, quantity, bands and wavelengths in the schema's
    metadata. NumPy: the spectra alone, float32 (points, bands). `X-Specimap-Total` counts the whole selection,
    `X-Specimap-Next-Offset` is present if there is another page.
    """
    media = chosen_type(request)
    limit = min(wanted.limit or JSON_PAGE, MOST_JSON_POINTS) if media == JSON else wanted.limit or PAGE
    with clouds.reading(cloud_id) as (record, cloud):
        numbers, selection = band_numbers(cloud, wanted.bands), selected(cloud, wanted.select)
        total, start = len(selection.indices), wanted.offset
        stop = min(start + limit, total)
        rows = max(0, stop - start)
        headers = {"X-Specimap-Total": str(total)}
        if stop < total:
            headers["X-Specimap-Next-Offset"] = str(stop)
        if media == NPY:
            width = cloud.bands if numbers is None else len(numbers)

            def spectra(a: int, b: int) -> Array:
                return cloud.spectra(selection.indices[start + a : start + b], numbers)

            return npy_answer((rows, width), spectra, headers)
        if media == ARROW:
            return arrow_answer(
                rows,
                lambda a, b: columns_of(cloud, selection, numbers, wanted.fields, slice(start + a, start + b)),
                _metadata(record, total=total, offset=start, **_described(cloud, numbers)),
                headers,
            )
        page = slice(start, stop)
        return json_answer(
            {
                "total": total,
                "offset": start,
                "next_offset": stop if stop < total else None,
                **_described(cloud, numbers),
                "indices": selection.indices[page],
                "spectra": cloud.spectra(selection.indices[page], numbers),
                "fields": {name: field_values(cloud, selection, name, page) for name in wanted.fields},
            },
            headers,
        )


@router.get("/clouds/{cloud_id}/bands/{band}", response_model=BandAnswer, responses=documented_responses(BandAnswer))
def read_band(principal: Reader, clouds: CloudsDep, request: Request, cloud_id: CloudId, band: Number) -> Response:
    """Return one band of all points, in their order. Arrow: column `value`; NumPy: float32 (points,)."""
    media = chosen_type(request)
    with clouds.reading(cloud_id) as (record, cloud):
        if band >= cloud.bands:
            raise NotFoundError(
                f"There is no band {band}: the cloud has {cloud.bands}.",
                advice=f"Bands count from 0 to {cloud.bands - 1}.",
            )
        # Spectra never change.
        etag = f'"{cloud_id}-{band}-{media.rpartition("/")[2]}"'
        headers = {"ETag": etag, "Cache-Control": CACHED, "Vary": "Accept, Authorization"}
        if known_to_client(request, etag):
            return Response(status_code=304, headers=headers)
        values = cloud.band(band)
        described = _described(cloud, np.array([band]))
        if media == NPY:
            return npy_answer((len(values),), lambda a, b: values[a:b], headers)
        if media == ARROW:
            return arrow_answer(
                len(values), lambda a, b: {"value": values[a:b]}, _metadata(record, **described), headers
            )
        return json_answer(
            {
                "band": band,
                "wavelength_nm": float(described["wavelength_nm"][0]),
                "quantity": cloud.quantity,
                "values": values,
            },
            headers,
        )


def _described(cloud: Cloud, numbers: Array | None) -> dict[str, Any]:
    bands = np.arange(cloud.bands) if numbers is None else numbers
    return {"quantity": cloud.quantity, "bands": bands, "wavelength_nm": cloud.wavelengths_nm[bands]}


def _metadata(record: CloudRecord, **values: Any) -> dict[str, str]:
    ready = {
        name: [v if np.isfinite(v) else None for v in value.tolist()] if isinstance(value, np.ndarray) else value
        for name, value in values.items()
    }
    return {"cloud_id": record.id, **{k: v if isinstance(v, str) else json_text(v) for k, v in ready.items()}}
