"""Pages of a small project among many, and places in a long queue, found by indexes.

Revision: 0006
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply."""
    for table in ("jobs", "clouds"):
        # With a default of the database's own, for rows that a program of the version before writes: housekeeping
        # gives them their project.
        op.add_column(table, sa.Column("project_id", sa.String(), nullable=False, server_default=sa.text("''")))
        op.execute(
            f"UPDATE {table} SET project_id = "
            f"(SELECT acquisitions.project_id FROM acquisitions WHERE acquisitions.id = {table}.acquisition_id)"
        )
        op.create_index(op.f(f"ix_{table}_project_id"), table, ["project_id", "id"])
    queued = sa.text("state = 'queued'")
    op.create_index(
        op.f("ix_jobs_queued"),
        "jobs",
        ["priority", "created_at", "id"],
        postgresql_where=queued,
        sqlite_where=queued,
    )


def downgrade() -> None:
    """Revert."""
    op.drop_index(op.f("ix_jobs_queued"), table_name="jobs")
    for table in ("clouds", "jobs"):
        op.drop_index(op.f(f"ix_{table}_project_id"), table_name=table)
        with op.batch_alter_table(table, schema=None) as batch_op:
            batch_op.drop_column("project_id")
