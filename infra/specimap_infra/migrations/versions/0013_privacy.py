"""Legal holds and erasures.

Revision: 0013
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from specimap_infra.tables import UtcDateTime

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply."""
    op.create_table(
        "legal_holds",
        sa.Column("acquisition_id", sa.String(), nullable=False),
        sa.Column("reason", sa.String(), nullable=False),
        sa.Column("created_at", UtcDateTime(), nullable=False),
        sa.Column("created_by", sa.String(), nullable=False),
        sa.ForeignKeyConstraint(
            ["acquisition_id"],
            ["acquisitions.id"],
            name=op.f("fk_legal_holds_acquisition_id_acquisitions"),
            ondelete="RESTRICT",
        ),
        sa.PrimaryKeyConstraint("acquisition_id", name=op.f("pk_legal_holds")),
    )
    op.create_table(
        "erasures",
        sa.Column("id", sa.String(), nullable=False),
        sa.Column("specimen_hash", sa.String(), nullable=False),
        sa.Column("acquisitions", sa.JSON(), nullable=False),
        sa.Column("removal", sa.JSON(), nullable=False),
        sa.Column("state", sa.String(), nullable=False),
        sa.Column("certificate", sa.JSON(), nullable=True),
        sa.Column("created_at", UtcDateTime(), nullable=False),
        sa.Column("created_by", sa.String(), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_erasures")),
    )
    op.create_index(op.f("ix_erasures_specimen_hash"), "erasures", ["specimen_hash"])


def downgrade() -> None:
    """Revert."""
    op.drop_table("erasures")
    op.drop_table("legal_holds")
