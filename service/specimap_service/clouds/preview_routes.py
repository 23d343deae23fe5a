"""Pictures of a cloud: colours, bands, normalised differences, labels."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi.concurrency import run_in_threadpool

from specimap_core import __version__
from specimap_core.errors import CloudDamagedError, NotFoundError
from specimap_core.json_text import json_text
from specimap_infra.tables import LabelVersion
from specimap_service.auth.dependencies import Permitted
from specimap_service.auth.object_ids import CloudId
from specimap_service.byte_ranges import VARY, known_to_client, names_tag
from specimap_service.clouds import drawing
from specimap_service.clouds.dependencies import CloudsDep, PicturesDep
from specimap_service.clouds.drawing import Drawing, Paint
from specimap_service.clouds.label_store import find_label
from specimap_service.clouds.open_clouds import OpenClouds
from specimap_service.clouds.picture_queue import PictureQueue
from specimap_service.clouds.pictures import LARGEST_SIDE, Grid
from specimap_service.context import AppContext, Context
from specimap_service.errors import RequestInvalidError

router = APIRouter(prefix="/v1/clouds/{cloud_id}/previews", tags=["previews"])
Size = Annotated[int, Query(ge=16, le=LARGEST_SIDE, description="Most pixels of the longer side; never enlarged.")]
GridChoice = Annotated[
    Grid, Query(description="`cube`: the cube's own pixels; `marker`: from above, x to the right, y up.")
]
Low = Annotated[
    float | None,
    Query(allow_inf_nan=False, description="Value at the lower end of the scale; by default the 2nd percentile."),
]
High = Annotated[
    float | None,
    Query(allow_inf_nan=False, description="Value at the upper end; by default the 98th percentile."),
]
BAND = r"^(\d{1,5}|\d{1,5}(\.\d{1,4})?nm)$"
TRUE_COLOUR = ("640nm", "550nm", "460nm")


def _band(description: str) -> Any:
    return Query(pattern=BAND, description=f"{description}: an index, or a wavelength as `640nm`.", max_length=16)


PNG: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "PNG, transparent where there is no point.",
        "content": {"image/png": {"schema": {"type": "string", "format": "binary"}}},
        "headers": {
            "ETag": {"schema": {"type": "string"}},
            "X-Specimap-Range": {
                "description": "Values at the ends of the colour scale: low,high.",
                "schema": {"type": "string"},
            },
            "X-Specimap-Extent-Mm": {
                "description": "With grid=marker, the edges: x_min,y_min,x_max,y_max.",
                "schema": {"type": "string"},
            },
        },
    },
    304: {"description": "The client has the current picture."},
}


@dataclass(frozen=True)
class Previews:
    """Answers to one request with a picture of a cloud, drawn or cached."""

    clouds: OpenClouds
    queue: PictureQueue
    request: Request
    key: str

    async def picture(self, cloud_id: str, grid: Grid, size: int, paint: Paint, parameters: list[Any]) -> Response:
        """Answer with a picture; ``parameters`` are everything else that it depends on."""
        record = await run_in_threadpool(self.clouds.record, cloud_id)
        # A cloud never changes: parameters and program version identify the picture.
        identity = json_text([__version__, cloud_id, grid, size, *parameters])
        tag = hashlib.sha256(identity.encode()).hexdigest()[:32]
        headers = {"ETag": f'"{tag}"', "Cache-Control": "private, no-cache", "Vary": VARY}
        if names_tag(self.request, f'"{tag}"'):
            # The picture was drawn for this client once.
            return Response(status_code=304, headers=headers)
        try:
            picture = await self.queue.picture(self.key, tag, Drawing(record.prefix, paint, grid, size))
        except CloudDamagedError as error:
            raise await run_in_threadpool(self.clouds.damage_of, cloud_id, error) from error
        if known_to_client(self.request, headers["ETag"]):
            # `*`: any picture, if there is one.
            return Response(status_code=304, headers=headers)
        if picture.range is not None:
            headers["X-Specimap-Range"] = ",".join(f"{value:.6g}" for value in picture.range)
        if picture.extent_mm is not None:
            headers["X-Specimap-Extent-Mm"] = ",".join(f"{value:.4f}" for value in picture.extent_mm)
        return Response(picture.png, headers=headers, media_type="image/png")


async def previews_of_request(
    principal: Permitted, request: Request, clouds: CloudsDep, queue: PicturesDep
) -> Previews:
    """Combine the objects that pictures need: a dependency, ``async`` so that it takes no thread."""
    return Previews(clouds, queue, request, principal.key_id)


PreviewsDep = Annotated[Previews, Depends(previews_of_request)]


@router.get("/rgb.png", response_class=Response, responses=PNG, operation_id="previews.get_rgb")
async def rgb(
    principal: Permitted,
    previews: PreviewsDep,
    cloud_id: CloudId,
    size: Size = 1024,
    grid: GridChoice = "cube",
) -> Response:
    """Show the photos' colours."""
    return await previews.picture(cloud_id, grid, size, drawing.rgb, ["rgb"])


@router.get("/pca.png", response_class=Response, responses=PNG, operation_id="previews.get_pca")
async def pca(
    principal: Permitted,
    previews: PreviewsDep,
    cloud_id: CloudId,
    size: Size = 1024,
    grid: GridChoice = "cube",
) -> Response:
    """Show the first three principal components of the spectra as colours, as the run drew them."""
    return await previews.picture(cloud_id, grid, size, drawing.pca, ["pca"])


@router.get("/band.png", response_class=Response, responses=PNG, operation_id="previews.get_band")
async def band(
    principal: Permitted,
    previews: PreviewsDep,
    cloud_id: CloudId,
    b: Annotated[str | None, _band("The band")] = None,
    nm: Annotated[float | None, Query(gt=0, lt=100_000, description="The band nearest to this, instead of b.")] = None,
    low: Low = None,
    high: High = None,
    size: Size = 1024,
    grid: GridChoice = "cube",
) -> Response:
    """Show one band in grey."""
    if (b is None) == (nm is None):
        raise RequestInvalidError("Which band is not said, or said twice.", advice="Give either b or nm.")
    chosen, limits = b if b is not None else f"{nm:.4f}nm", _limits(low, high)
    paint = partial(drawing.band, given=chosen, limits=limits)
    return await previews.picture(cloud_id, grid, size, paint, ["band", chosen, limits])


@router.get("/composite.png", response_class=Response, responses=PNG, operation_id="previews.get_composite")
async def composite(
    principal: Permitted,
    previews: PreviewsDep,
    cloud_id: CloudId,
    r: Annotated[str, _band("Band shown in red")] = TRUE_COLOUR[0],
    g: Annotated[str, _band("Band shown in green")] = TRUE_COLOUR[1],
    b: Annotated[str, _band("Band shown in blue")] = TRUE_COLOUR[2],
    size: Size = 1024,
    grid: GridChoice = "cube",
) -> Response:
    """Show three bands as red, green and blue, each between its 2nd and 98th percentile."""
    paint = partial(drawing.composite, given=(r, g, b))
    return await previews.picture(cloud_id, grid, size, paint, ["composite", r, g, b])


@router.get("/index.png", response_class=Response, responses=PNG, operation_id="previews.get_index")
async def index(
    principal: Permitted,
    previews: PreviewsDep,
    cloud_id: CloudId,
    a: Annotated[str, _band("First band")],
    b: Annotated[str, _band("Second band")],
    low: Low = None,
    high: High = None,
    size: Size = 1024,
    grid: GridChoice = "cube",
) -> Response:
    """Show the normalised difference (a - b) / (a + b) as a colour scale; transparent where a + b is not positive."""
    limits = _limits(low, high)
    paint = partial(drawing.index, given=(a, b), limits=limits)
    return await previews.picture(cloud_id, grid, size, paint, ["index", a, b, limits])


@router.get("/label.png", response_class=Response, responses=PNG, operation_id="previews.get_label")
async def label(
    context: Context,
    principal: Permitted,
    previews: PreviewsDep,
    cloud_id: CloudId,
    name: Annotated[str, Query(pattern=r"^[a-z0-9_-]{1,64}$", description="The layer.")],
    version: Annotated[int | None, Query(ge=1, le=10**9, description="By default the current one.")] = None,
    class_value: Annotated[
        int | None,
        Query(alias="class", ge=0, le=65535, description="Class whose probability is shown; by default the first."),
    ] = None,
    low: Low = None,
    high: High = None,
    size: Size = 1024,
    grid: GridChoice = "cube",
) -> Response:
    """Show a label layer over the dimmed photos: classes in their colours, probabilities on a scale from 0 to 1."""
    limits = _limits(low, high)
    row = await run_in_threadpool(_label_row, context, previews.clouds, cloud_id, name, version)
    known = [item["value"] for item in row.classes]
    if class_value is not None and (row.kind == "class" or class_value not in known):
        raise NotFoundError(
            f"The layer {name!r} has no probability of class {class_value}.",
            advice="Its classes are in the details.",
            classes=known,
        )
    paint: Paint
    if row.kind == "class":
        paint = partial(drawing.classes, prefix=row.storage_prefix, known=row.classes)
    else:
        column = 0 if class_value is None else known.index(class_value)
        paint = partial(drawing.probability, prefix=row.storage_prefix, column=column, limits=limits)
    parameters = ["label", row.storage_prefix, class_value, limits]
    return await previews.picture(cloud_id, grid, size, paint, parameters)


def _label_row(context: AppContext, clouds: OpenClouds, cloud_id: str, name: str, version: int | None) -> LabelVersion:
    clouds.record(cloud_id)
    with context.database.session() as session:
        return find_label(session, cloud_id, name, version)


def _limits(low: float | None, high: float | None) -> tuple[float, float] | None:
    if low is None and high is None:
        return None
    if low is None or high is None or not low < high:
        raise RequestInvalidError("low and high are no range.", advice="Give both, low below high, or neither.")
    return low, high
