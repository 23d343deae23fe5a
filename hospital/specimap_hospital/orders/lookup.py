"""Looking an order up in all sources that are set."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

from specimap_hospital.connections import PeerError
from specimap_hospital.orders.mapping import order_of
from specimap_hospital.orders.model import MOST_ORDERS, Order, OrderQuery, Orders
from specimap_hospital.orders.qido import find_studies
from specimap_hospital.orders.worklist import find_in_worklist
from specimap_infra.errors import OrderSourceMissingError, OrderSourceUnavailableError
from specimap_infra.logs import logger
from specimap_infra.settings import ServiceSettings

if TYPE_CHECKING:
    from pydicom.dataset import Dataset

Source = Literal["worklist", "qido"]
Find = Callable[[ServiceSettings, OrderQuery], "tuple[list[Dataset], bool]"]
FINDERS: dict[Source, Find] = {"worklist": find_in_worklist, "qido": find_studies}


def find_orders(settings: ServiceSettings, query: OrderQuery) -> Orders:
    """Look an order up; blocks at most a little longer than ``orders_seconds`` for each source.

    What the worklist has is not shown a second time as a study.

    Raises:
        OrderSourceMissingError: none is set. OrderSourceUnavailableError: one does not answer, or refuses.
        SettingsError: the certificates for it do not read.
    """
    named: dict[Source, str] = {"worklist": settings.worklist_host, "qido": settings.orders_url}
    sources = [source for source, place in named.items() if place]
    if not sources:
        raise OrderSourceMissingError(
            "No worklist to look orders up in is set.",
            advice="Enter the order by hand, or set SPECIMAP_WORKLIST_HOST or SPECIMAP_ORDERS_URL.",
        )
    found: list[Order] = []
    seen: set[str] = set()
    more, unreadable = False, 0
    for source in sources:
        try:
            datasets, longer = FINDERS[source](settings, query)
        except PeerError as error:
            logger().warning("orders not found", source=source, reason=error.reason)
            raise OrderSourceUnavailableError(
                f"The {source} does not answer as it should ({error.reason}).",
                advice="Try again, or enter the order by hand; docs/pacs.md lists the reasons.",
                source=source,
                reason=error.reason,
            ) from None
        more |= longer
        for dataset in datasets:
            try:
                order = order_of(dataset, source)
            except (ValueError, TypeError, AttributeError, KeyError, IndexError, LookupError):
                order = None
            if order is None:
                unreadable += 1
            elif order.study.study_instance_uid is None or order.study.study_instance_uid not in seen:
                seen.add(order.study.study_instance_uid or "")
                found.append(order)
    return Orders(orders=found[:MOST_ORDERS], more=more or len(found) > MOST_ORDERS, unreadable=unreadable)
