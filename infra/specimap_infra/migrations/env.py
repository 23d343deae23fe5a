"""Alembic's environment: on the connection it is given."""

from __future__ import annotations

from alembic import context

from specimap_infra.tables import Base

context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=Base.metadata,
    # SQLite changes tables by copying them.
    render_as_batch=True,
)
with context.begin_transaction():
    context.run_migrations()
