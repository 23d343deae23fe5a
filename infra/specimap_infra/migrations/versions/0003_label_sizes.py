"""Stored bytes of label versions, which count against the quota of their key.

Revision: 0003
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply."""
    # With a default of the database's own, for rows that a service of the version before writes.
    op.add_column("labels", sa.Column("size", sa.BigInteger(), nullable=False, server_default=sa.text("0")))


def downgrade() -> None:
    """Revert."""
    with op.batch_alter_table("labels", schema=None) as batch_op:
        batch_op.drop_column("size")
