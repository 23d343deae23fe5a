"""Requests with an idempotency key, of all kinds in one table; those that made jobs are taken over.

Revision: 0005
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from specimap_infra.tables import UtcDateTime

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply."""
    op.create_table(
        "repeatable_requests",
        sa.Column("key_id", sa.String(), nullable=False),
        sa.Column("name", sa.String(), nullable=False),
        sa.Column("request_hash", sa.String(), nullable=False),
        sa.Column("object_id", sa.String(), nullable=False),
        sa.Column("salt", sa.String(), nullable=False),
        sa.Column("created_at", UtcDateTime(), nullable=False),
        sa.PrimaryKeyConstraint("key_id", "name", name=op.f("pk_repeatable_requests")),
    )
    op.create_index(op.f("ix_repeatable_requests_created_at"), "repeatable_requests", ["created_at"])
    op.execute(
        "INSERT INTO repeatable_requests (key_id, name, request_hash, object_id, salt, created_at) "
        "SELECT created_by, idempotency_key, request_hash, id, '', created_at FROM jobs "
        "WHERE idempotency_key IS NOT NULL"
    )


def downgrade() -> None:
    """Revert."""
    op.drop_index(op.f("ix_repeatable_requests_created_at"), table_name="repeatable_requests")
    op.drop_table("repeatable_requests")
