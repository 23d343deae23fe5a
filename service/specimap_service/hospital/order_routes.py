"""Looking up an order in the hospital's worklist."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response
from fastapi.concurrency import run_in_threadpool

from specimap_hospital.orders.lookup import find_orders
from specimap_hospital.orders.model import OrderQuery, Orders
from specimap_service.auth.dependencies import Permitted
from specimap_service.auth.keys import Principal
from specimap_service.context import AppContext, Context, audit
from specimap_service.hospital.dependencies import AskingDep

router = APIRouter(prefix="/v1", tags=["orders"])


@router.post("/orders/search", operation_id="orders.select")
async def search_orders(
    context: Context, principal: Permitted, asking: AskingDep, request: Request, response: Response, wanted: OrderQuery
) -> Orders:
    """Look an order up by accession number, patient id or station; PUT its `study` to choose it.

    What is looked for stands in the body, since proxies keep the addresses of requests in their logs.
    """
    response.headers["Cache-Control"] = "no-store"
    found = await asking.run_while(request.receive, principal.key_id, lambda: find_orders(context.settings, wanted))
    await run_in_threadpool(_note, context, principal, found)
    return found


def _note(context: AppContext, principal: Principal, found: Orders) -> None:
    with context.database.session() as session:
        audit(session, principal.key_id, "order.search", principal.key_id, found=len(found.orders))
