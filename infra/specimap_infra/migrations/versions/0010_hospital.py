"""Study contexts, and the outbox to an archive.

Revision: 0010
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from specimap_infra.tables import UtcDateTime

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply."""
    op.create_table(
        "studies",
        sa.Column("acquisition_id", sa.String(), nullable=False),
        sa.Column("key_id", sa.String(), nullable=False),
        sa.Column("sealed", sa.String(), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("updated_at", UtcDateTime(), nullable=False),
        sa.Column("updated_by", sa.String(), nullable=False),
        sa.ForeignKeyConstraint(
            ["acquisition_id"],
            ["acquisitions.id"],
            name=op.f("fk_studies_acquisition_id_acquisitions"),
            ondelete="CASCADE",
        ),
        sa.PrimaryKeyConstraint("acquisition_id", name=op.f("pk_studies")),
    )
    op.create_table(
        "dicom_sets",
        sa.Column("id", sa.String(), nullable=False),
        sa.Column("cloud_id", sa.String(), nullable=False),
        sa.Column("options", sa.JSON(), nullable=False),
        sa.Column("first", sa.Boolean(), nullable=False),
        sa.Column("study_version", sa.Integer(), nullable=False),
        sa.Column("state", sa.String(), nullable=False),
        sa.Column("attempts", sa.Integer(), nullable=False),
        sa.Column("next_at", UtcDateTime(), nullable=False),
        sa.Column("holder", sa.String(), nullable=True),
        sa.Column("held_until", UtcDateTime(), nullable=False),
        sa.Column("transaction_uid", sa.String(), nullable=True),
        sa.Column("reason", sa.String(), nullable=True),
        sa.Column("created_at", UtcDateTime(), nullable=False),
        sa.Column("created_by", sa.String(), nullable=False),
        sa.Column("settled_at", UtcDateTime(), nullable=True),
        sa.ForeignKeyConstraint(
            ["cloud_id"], ["clouds.id"], name=op.f("fk_dicom_sets_cloud_id_clouds"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_dicom_sets")),
    )
    for column in ("cloud_id", "next_at", "settled_at", "state", "transaction_uid"):
        op.create_index(op.f(f"ix_dicom_sets_{column}"), "dicom_sets", [column])
    op.create_table(
        "dicom_instances",
        sa.Column("id", sa.String(), nullable=False),
        sa.Column("set_id", sa.String(), nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("kind", sa.String(), nullable=False),
        sa.Column("sop_class_uid", sa.String(), nullable=False),
        sa.Column("sop_instance_uid", sa.String(), nullable=False),
        sa.Column("size", sa.BigInteger(), nullable=False),
        sa.Column("state", sa.String(), nullable=False),
        sa.Column("attempts", sa.Integer(), nullable=False),
        sa.Column("reason", sa.String(), nullable=True),
        sa.Column("sent_at", UtcDateTime(), nullable=True),
        sa.ForeignKeyConstraint(
            ["set_id"], ["dicom_sets.id"], name=op.f("fk_dicom_instances_set_id_dicom_sets"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_dicom_instances")),
        sa.UniqueConstraint("set_id", "sop_instance_uid", name=op.f("uq_dicom_instances_set_id")),
    )
    op.create_index(op.f("ix_dicom_instances_set_id"), "dicom_instances", ["set_id"])
    op.create_index(op.f("ix_dicom_instances_sop_instance_uid"), "dicom_instances", ["sop_instance_uid"])
    op.create_table(
        "received_studies",
        sa.Column("digest", sa.String(), nullable=False),
        sa.Column("acquisition_id", sa.String(), nullable=False),
        sa.ForeignKeyConstraint(
            ["acquisition_id"],
            ["acquisitions.id"],
            name=op.f("fk_received_studies_acquisition_id_acquisitions"),
            ondelete="CASCADE",
        ),
        sa.PrimaryKeyConstraint("digest", name=op.f("pk_received_studies")),
    )
    op.create_index(op.f("ix_received_studies_acquisition_id"), "received_studies", ["acquisition_id"])


def downgrade() -> None:
    """Revert."""
    op.drop_table("received_studies")
    op.drop_table("dicom_instances")
    op.drop_table("dicom_sets")
    op.drop_table("studies")
