"""People who sign in with an identity provider.

Revision: 0011
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from specimap_infra.tables import UtcDateTime

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply."""
    op.create_table(
        "people",
        sa.Column("id", sa.String(), nullable=False),
        sa.Column("issuer", sa.String(), nullable=False),
        sa.Column("subject_hash", sa.String(), nullable=False),
        sa.Column("created_at", UtcDateTime(), nullable=False),
        sa.Column("last_used_at", UtcDateTime(), nullable=True),
        sa.Column("blocked_at", UtcDateTime(), nullable=True),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_people")),
        sa.UniqueConstraint("issuer", "subject_hash", name=op.f("uq_people_issuer")),
    )
    op.create_table(
        "sign_in_attempts",
        sa.Column("id", sa.String(), nullable=False),
        sa.Column("browser_hash", sa.String(), nullable=False),
        sa.Column("nonce", sa.String(), nullable=False),
        sa.Column("code_verifier", sa.String(), nullable=False),
        sa.Column("return_to", sa.String(), nullable=False),
        sa.Column("session_before", sa.String(), nullable=True),
        sa.Column("expires_at", UtcDateTime(), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_sign_in_attempts")),
    )
    op.create_index(op.f("ix_sign_in_attempts_expires_at"), "sign_in_attempts", ["expires_at"])
    with op.batch_alter_table("sessions") as batch_op:
        batch_op.alter_column("key_id", existing_type=sa.String(), nullable=True)
        batch_op.add_column(sa.Column("person_id", sa.String(), nullable=True))
        batch_op.add_column(sa.Column("granted", sa.JSON(), nullable=True))
        batch_op.create_foreign_key(
            op.f("fk_sessions_person_id_people"), "people", ["person_id"], ["id"], ondelete="CASCADE"
        )
        batch_op.create_index(op.f("ix_sessions_person_id"), ["person_id"])


def downgrade() -> None:
    """Revert."""
    op.execute("DELETE FROM sessions WHERE key_id IS NULL")
    with op.batch_alter_table("sessions") as batch_op:
        batch_op.drop_index(op.f("ix_sessions_person_id"))
        batch_op.drop_constraint(op.f("fk_sessions_person_id_people"), type_="foreignkey")
        batch_op.drop_column("granted")
        batch_op.drop_column("person_id")
        batch_op.alter_column("key_id", existing_type=sa.String(), nullable=False)
    op.drop_index(op.f("ix_sign_in_attempts_expires_at"), table_name="sign_in_attempts")
    op.drop_table("sign_in_attempts")
    op.drop_table("people")
