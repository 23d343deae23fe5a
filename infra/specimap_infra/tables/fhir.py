"""Table of the results that the FHIR server is told of."""

from __future__ import annotations

import datetime
from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import Mapped, mapped_column

from specimap_infra.database import utc_now
from specimap_infra.tables.base import Base


class FhirNotice(Base):
    """A result that the FHIR server is told of, once its objects are in the archive."""

    __tablename__ = "fhir_notices"

    cloud_id: Mapped[str] = mapped_column(sa.ForeignKey("clouds.id", ondelete="CASCADE"), primary_key=True)
    study_version: Mapped[int]
    """The study context that it was last told with: a changed one is told again."""
    state: Mapped[str]
    """``pending``, ``sent``, ``refused`` (it would be again) or ``given_up``."""
    attempts: Mapped[int] = mapped_column(default=0)
    next_at: Mapped[datetime.datetime] = mapped_column(default=utc_now, index=True)
    error: Mapped[dict[str, Any] | None]
    """Code, message, advice and details of the last failure; no word of the server's."""
    sent_at: Mapped[datetime.datetime | None]
