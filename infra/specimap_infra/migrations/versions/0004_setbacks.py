"""Setbacks of jobs and exports, which tell work that kills its process from work whose process was killed.

Revision: 0004
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply."""
    for table in ("jobs", "exports"):
        # With a default of the database's own, for rows that a worker of the version before writes.
        op.add_column(table, sa.Column("setbacks", sa.JSON(), nullable=False, server_default=sa.text("'{}'")))


def downgrade() -> None:
    """Revert."""
    for table in ("exports", "jobs"):
        with op.batch_alter_table(table, schema=None) as batch_op:
            batch_op.drop_column("setbacks")
