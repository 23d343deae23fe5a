"""Uploads that API processes of several machines share: their parts in the storage, and who writes to them.

Revision: 0007
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None

COLUMNS = ("received", "holder", "held_until", "wanted_at")


def upgrade() -> None:
    """Apply."""
    zero = sa.text("0")
    # With defaults of the database's own, for rows that a service of the version before writes.
    op.add_column("uploads", sa.Column("received", sa.BigInteger(), nullable=False, server_default=zero))
    op.add_column("uploads", sa.Column("holder", sa.String(), nullable=True))
    op.add_column("uploads", sa.Column("held_until", sa.Double(), nullable=False, server_default=zero))
    op.add_column("uploads", sa.Column("wanted_at", sa.Double(), nullable=False, server_default=zero))
    op.create_table(
        "upload_parts",
        sa.Column("upload_id", sa.String(), nullable=False),
        sa.Column("start", sa.BigInteger(), nullable=False),
        sa.Column("size", sa.BigInteger(), nullable=False),
        sa.Column("storage_key", sa.String(), nullable=False),
        sa.ForeignKeyConstraint(
            ["upload_id"], ["uploads.id"], name=op.f("fk_upload_parts_upload_id_uploads"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("upload_id", "start", name=op.f("pk_upload_parts")),
    )


def downgrade() -> None:
    """Revert."""
    op.drop_table("upload_parts")
    with op.batch_alter_table("uploads", schema=None) as batch_op:
        for name in reversed(COLUMNS):
            batch_op.drop_column(name)
