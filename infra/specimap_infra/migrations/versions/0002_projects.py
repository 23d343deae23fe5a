"""Projects: what is there belongs to the default one, and keys keep what they could do.

Revision: 0002
"""

from __future__ import annotations

import datetime
from collections.abc import Callable

import sqlalchemy as sa
from alembic import op

from specimap_infra.tables import UtcDateTime

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

DEFAULT = "prj_00000000000000000000000000"
KEYS = sa.table("api_keys", sa.column("id", sa.String), sa.column("scopes", sa.JSON))


def upgrade() -> None:
    """Apply."""
    projects = op.create_table(
        "projects",
        sa.Column("id", sa.String(), nullable=False),
        sa.Column("name", sa.String(), nullable=False),
        sa.Column("created_at", UtcDateTime(), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_projects")),
        sa.UniqueConstraint("name", name=op.f("uq_projects_name")),
    )
    now = datetime.datetime.now(datetime.UTC)
    op.bulk_insert(projects, [{"id": DEFAULT, "name": "default", "created_at": now}])
    for table in ("api_keys", "acquisitions", "audit"):
        # The default fills in the rows that are there. It goes again: a new row without a project is a fault.
        with op.batch_alter_table(table) as batch:
            batch.add_column(sa.Column("project_id", sa.String(), nullable=False, server_default=DEFAULT))
        with op.batch_alter_table(table) as batch:
            batch.alter_column("project_id", existing_type=sa.String(), existing_nullable=False, server_default=None)
            # In the order of lists, so that a page takes no sorting.
            columns = ["project_id"] if table == "api_keys" else ["project_id", "id"]
            batch.create_index(op.f(f"ix_{table}_project_id"), columns)
            if table != "audit":
                batch.create_foreign_key(op.f(f"fk_{table}_project_id_projects"), "projects", ["project_id"], ["id"])
    # An administrator's key may do everything without being told.
    _change_scopes(
        lambda scopes: [*scopes, "intraoperative"] if "upload" in scopes and "admin" not in scopes else scopes
    )


def downgrade() -> None:
    """Revert."""
    _change_scopes(lambda scopes: [scope for scope in scopes if scope != "intraoperative"])
    for table in ("audit", "acquisitions", "api_keys"):
        with op.batch_alter_table(table) as batch:
            if table != "audit":
                batch.drop_constraint(op.f(f"fk_{table}_project_id_projects"), type_="foreignkey")
            batch.drop_index(op.f(f"ix_{table}_project_id"))
            batch.drop_column("project_id")
    op.drop_table("projects")


def _change_scopes(change: Callable[[list[str]], list[str]]) -> None:
    connection = op.get_bind()
    for key_id, scopes in connection.execute(sa.select(KEYS.c.id, KEYS.c.scopes)).all():
        connection.execute(sa.update(KEYS).where(KEYS.c.id == key_id).values(scopes=change(scopes)))
