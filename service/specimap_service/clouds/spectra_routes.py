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
    Pace,
    Rows,
    arrow_answer,
    chosen_type,
    documented_responses,
    json_answer,
    json_rows_answer,
    npy_answer,
)
from specimap_service.auth.dependencies import Permitted
from specimap_service.auth.object_ids import CloudId
from specimap_service.body_limits import parsed
from specimap_service.byte_ranges import CACHED, VARY, known_to_client
from specimap_service.clouds.band_copies import BandCopies
from specimap_service.clouds.dependencies import BandCopiesDep, CloudsDep, ReadingDep
from specimap_service.clouds.open_clouds import CloudRecord, OpenClouds
from specimap_service.clouds.spectra import (
    MOST_JSON_VALUES,
    MOST_VALUES,
    PointSpectra,
    Selection,
    band_numbers,
    columns_of,
    field_values,
    flag_names,
    listed_bands,
    selected,
)
from specimap_service.clouds.spectra_schemas import (
    JSON_PAGE,
    MOST_JSON_POINTS,
    PAGE,
    BandAnswer,
    Point,
    SpectraAnswer,
    SpectraRequest,
)

router = APIRouter(prefix="/v1", tags=["spectra"])
BandList = Annotated[
    str | None,
    Query(pattern=r"^\d{1,5}(-\d{1,5})?(,\d{1,5}(-\d{1,5})?)*$", max_length=2000, description="As in `0,5,10-20`."),
]
Number = Annotated[int, Path(ge=0, lt=2**32)]


@router.get("/clouds/{cloud_id}/points/{index}", response_model=Point, operation_id="spectra.get_point")
def show_point(
    principal: Permitted, clouds: CloudsDep, cloud_id: CloudId, index: Number, bands: BandList = None
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


async def _wanted(principal: Permitted, request: Request, reading: ReadingDep) -> SpectraRequest:
    return await parsed(request, SpectraRequest, reading.parses, principal.key_id)


@router.post(
    "/clouds/{cloud_id}/spectra",
    response_model=SpectraAnswer,
    responses=documented_responses(SpectraAnswer),
    openapi_extra=BODY,
    operation_id="spectra.select",
)
async def read_spectra(
    principal: Permitted,
    clouds: CloudsDep,
    reading: ReadingDep,
    request: Request,
    cloud_id: CloudId,
    wanted: Annotated[SpectraRequest, Depends(_wanted)],
) -> Response:
    """Return spectra of the selected points, a page at a time.

    Arrow: columns `index`, the requested fields, `spectrum`; total, quantity, bands and wavelengths in the schema's
    metadata. NumPy: the spectra alone, float32 (points, bands). `X-Specimap-Total` counts the whole selection,
    `X-Specimap-Next-Offset` is present if there is another page.
    """
    key, media = principal.key_id, chosen_type(request)
    return await reading.run(key, _spectra, clouds, cloud_id, wanted, media, reading.pace(key))


def _spectra(clouds: OpenClouds, cloud_id: str, wanted: SpectraRequest, media: str, pace: Pace) -> Response:
    with clouds.reading(cloud_id) as (record, cloud):
        numbers, selection = band_numbers(cloud, wanted.bands), selected(cloud, wanted.select)
        width = cloud.bands if numbers is None else len(numbers)
        total, start = len(selection.indices), wanted.offset
        stop = min(start + _page_points(wanted.limit, width, json=media == JSON), total)
        page = Selection(selection.indices[start:stop].copy(), selection.centre)
        spectra, rows = PointSpectra(cloud, page.indices, numbers), len(page.indices)
        fields, headers = wanted.fields, {"X-Specimap-Total": str(total)}
        if stop < total:
            headers["X-Specimap-Next-Offset"] = str(stop)
        if media == NPY:
            return npy_answer((rows, width), spectra.read, headers, pace)
        if media == ARROW:
            return arrow_answer(
                rows,
                lambda a, b: columns_of(cloud, page, spectra, fields, a, b),
                _metadata(record, total=total, offset=start, **_described(cloud, numbers)),
                headers,
                width,
                pace,
            )
        return json_rows_answer(
            {
                "total": total,
                "offset": start,
                "next_offset": stop if stop < total else None,
                **_described(cloud, numbers),
                "indices": page.indices,
            },
            "spectra",
            Rows(rows, width, spectra.read),
            {"fields": {name: field_values(cloud, page, name, slice(None)) for name in fields}},
            headers,
            pace,
        )


def _page_points(limit: int | None, width: int, *, json: bool) -> int:
    """Return the most points of a page: as asked for, but for bounds on points, and on points times bands."""
    if json:
        return max(1, min(limit or JSON_PAGE, MOST_JSON_POINTS, MOST_JSON_VALUES // max(width, 1)))
    return max(1, min(limit or PAGE, MOST_VALUES // max(width, 1)))


@router.get(
    "/clouds/{cloud_id}/bands/{band}",
    response_model=BandAnswer,
    responses=documented_responses(BandAnswer),
    operation_id="spectra.get_band",
)
async def read_band(
    principal: Permitted,
    clouds: CloudsDep,
    copies: BandCopiesDep,
    reading: ReadingDep,
    request: Request,
    cloud_id: CloudId,
    band: Number,
) -> Response:
    """Return one band of all points, in their order. Arrow: column `value`; NumPy: float32 (points,)."""
    key = principal.key_id
    return await reading.run(key, _band, clouds, copies, cloud_id, band, request, reading.pace(key))


def _band(clouds: OpenClouds, copies: BandCopies, cloud_id: str, band: int, request: Request, pace: Pace) -> Response:
    media = chosen_type(request)
    with clouds.reading(cloud_id) as (record, cloud):
        if band >= cloud.bands:
            raise NotFoundError(
                f"There is no band {band}: the cloud has {cloud.bands}.",
                advice=f"Bands count from 0 to {cloud.bands - 1}.",
            )
        # Spectra never change.
        etag = f'"{cloud_id}-{band}-{media.rpartition("/")[2]}"'
        headers = {"ETag": etag, "Cache-Control": CACHED, "Vary": f"Accept, {VARY}"}
        if known_to_client(request, etag):
            return Response(status_code=304, headers=headers)
        stored = copies.band(record, band)
        values = cloud.band(band) if stored is None else cloud.decode(stored)
        described = _described(cloud, np.array([band]))
        if media == NPY:
            return npy_answer((len(values),), lambda a, b: values[a:b], headers, pace)
        if media == ARROW:
            return arrow_answer(
                len(values), lambda a, b: {"value": values[a:b]}, _metadata(record, **described), headers, pace=pace
            )
        before = {"band": band, "wavelength_nm": float(described["wavelength_nm"][0]), "quantity": cloud.quantity}
        rows = Rows(len(values), 1, lambda a, b: values[a:b])
        return json_rows_answer(before, "values", rows, headers=headers, pace=pace)


def _described(cloud: Cloud, numbers: Array | None) -> dict[str, Any]:
    bands = np.arange(cloud.bands) if numbers is None else numbers
    return {"quantity": cloud.quantity, "bands": bands, "wavelength_nm": cloud.wavelengths_nm[bands]}


def _metadata(record: CloudRecord, **values: Any) -> dict[str, str]:
    ready = {
        name: [v if np.isfinite(v) else None for v in value.tolist()] if isinstance(value, np.ndarray) else value
        for name, value in values.items()
    }
    return {"cloud_id": record.id, **{k: v if isinstance(v, str) else json_text(v) for k, v in ready.items()}}
