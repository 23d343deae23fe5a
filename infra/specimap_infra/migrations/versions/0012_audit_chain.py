"""The audit trail as a chain: what each entry tells beside the action, its place, and triggers that keep it.

Entries that are there get their places from the sealer, when a program of this release starts.

Revision: 0012
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from specimap_infra.audit.triggers import create_triggers, drop_triggers
from specimap_infra.tables import UtcDateTime

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None

GENESIS = "0" * 64
UNSEALED = sa.text("seq IS NULL")


def upgrade() -> None:
    """Apply."""
    with op.batch_alter_table("audit") as batch:
        batch.add_column(sa.Column("kind", sa.String(), nullable=False, server_default=sa.text("'change'")))
        batch.add_column(sa.Column("outcome", sa.String(), nullable=False, server_default=sa.text("'success'")))
        batch.add_column(sa.Column("status", sa.Integer(), nullable=True))
        batch.add_column(sa.Column("acquisition_id", sa.String(), nullable=True))
        batch.add_column(sa.Column("address", sa.String(), nullable=False, server_default=sa.text("''")))
        batch.add_column(sa.Column("count", sa.Integer(), nullable=False, server_default=sa.text("1")))
        batch.add_column(sa.Column("seq", sa.BigInteger(), nullable=True))
        batch.add_column(sa.Column("previous_hash", sa.String(), nullable=True))
        batch.add_column(sa.Column("hash", sa.String(), nullable=True))
        batch.create_index(op.f("ix_audit_acquisition_id"), ["acquisition_id"])
        batch.create_unique_constraint(op.f("uq_audit_seq"), ["seq"])
    op.create_index("ix_audit_unsealed", "audit", ["id"], postgresql_where=UNSEALED, sqlite_where=UNSEALED)
    head = op.create_table(
        "audit_head",
        sa.Column("id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("seq", sa.BigInteger(), nullable=False),
        sa.Column("hash", sa.String(), nullable=False),
        sa.Column("pruned_seq", sa.BigInteger(), nullable=False),
        sa.Column("pruned_hash", sa.String(), nullable=False),
        sa.Column("salt", sa.String(), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_audit_head")),
    )
    empty = {"id": 1, "seq": 0, "hash": GENESIS, "pruned_seq": 0, "pruned_hash": GENESIS, "salt": ""}
    op.bulk_insert(head, [empty])
    op.create_table(
        "audit_cursors",
        sa.Column("destination", sa.String(), nullable=False),
        sa.Column("seq", sa.BigInteger(), nullable=False),
        sa.Column("updated_at", UtcDateTime(), nullable=False),
        sa.PrimaryKeyConstraint("destination", name=op.f("pk_audit_cursors")),
    )
    create_triggers(op.get_bind())


def downgrade() -> None:
    """Revert."""
    drop_triggers(op.get_bind())
    op.drop_table("audit_cursors")
    op.drop_table("audit_head")
    op.drop_index("ix_audit_unsealed", table_name="audit")
    with op.batch_alter_table("audit") as batch:
        batch.drop_constraint(op.f("uq_audit_seq"), type_="unique")
        batch.drop_index(op.f("ix_audit_acquisition_id"))
        for name in (
            *("hash", "previous_hash", "seq", "count", "address", "acquisition_id", "status", "outcome", "kind"),
        ):
            batch.drop_column(name)
