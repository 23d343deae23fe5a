"""Sessions of people who signed in with a key.

Revision: 0008
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from specimap_infra.tables import UtcDateTime

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None

INDEXED = ("key_id", "share_id", "expires_at")


def upgrade() -> None:
    """Apply."""
    op.create_table(
        "sessions",
        sa.Column("id", sa.String(), nullable=False),
        sa.Column("key_id", sa.String(), nullable=False),
        sa.Column("share_id", sa.String(), nullable=True),
        sa.Column("created_at", UtcDateTime(), nullable=False),
        sa.Column("expires_at", UtcDateTime(), nullable=False),
        sa.ForeignKeyConstraint(
            ["key_id"], ["api_keys.id"], name=op.f("fk_sessions_key_id_api_keys"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_sessions")),
    )
    for name in INDEXED:
        op.create_index(op.f(f"ix_sessions_{name}"), "sessions", [name])


def downgrade() -> None:
    """Revert."""
    for name in reversed(INDEXED):
        op.drop_index(op.f(f"ix_sessions_{name}"), table_name="sessions")
    op.drop_table("sessions")
