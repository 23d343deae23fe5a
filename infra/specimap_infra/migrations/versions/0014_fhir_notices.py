"""Results that a FHIR server is told of.

Revision: 0014
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from specimap_infra.tables import UtcDateTime

revision = "0014"
down_revision = "0013"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply."""
    op.create_table(
        "fhir_notices",
        sa.Column("cloud_id", sa.String(), nullable=False),
        sa.Column("study_version", sa.Integer(), nullable=False),
        sa.Column("state", sa.String(), nullable=False),
        sa.Column("attempts", sa.Integer(), nullable=False),
        sa.Column("next_at", UtcDateTime(), nullable=False),
        sa.Column("error", sa.JSON(), nullable=True),
        sa.Column("sent_at", UtcDateTime(), nullable=True),
        sa.ForeignKeyConstraint(
            ["cloud_id"], ["clouds.id"], name=op.f("fk_fhir_notices_cloud_id_clouds"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("cloud_id", name=op.f("pk_fhir_notices")),
    )
    op.create_index(op.f("ix_fhir_notices_next_at"), "fhir_notices", ["next_at"])


def downgrade() -> None:
    """Revert."""
    op.drop_index(op.f("ix_fhir_notices_next_at"), table_name="fhir_notices")
    op.drop_table("fhir_notices")
