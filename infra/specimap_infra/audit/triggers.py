"""Triggers that make the audit trail append-only in the database itself.

A row may be inserted; it may be put into the chain once, with nothing else changed; and it may be deleted once the head
says that it belongs to the removed beginning. A migration that rebuilds the table, as SQLite's batch mode does, has to
call :func:`create_triggers` again.
"""

from __future__ import annotations

import sqlalchemy as sa

MESSAGE = "the audit trail is append-only"
_FIXED = (
    *("id", "at", "key_id", "project_id", "acquisition_id", "kind", "action", "target", "outcome", "status"),
    *("address", "count", "details", "correlation_id"),
)
_SEALED = ("seq", "previous_hash", "hash")


def create_triggers(connection: sa.Connection) -> None:
    """Create the triggers, or create them anew."""
    drop_triggers(connection)
    for statement in _SQLITE if connection.dialect.name == "sqlite" else _POSTGRESQL:
        connection.exec_driver_sql(statement)


def drop_triggers(connection: sa.Connection) -> None:
    """Remove the triggers."""
    if connection.dialect.name == "sqlite":
        for name in ("audit_update", "audit_delete"):
            connection.exec_driver_sql(f"DROP TRIGGER IF EXISTS {name}")
        return
    for name in ("audit_update", "audit_delete", "audit_truncate"):
        connection.exec_driver_sql(f"DROP TRIGGER IF EXISTS {name} ON audit")
    connection.exec_driver_sql("DROP FUNCTION IF EXISTS specimap_audit_guard()")


_CHANGED = " OR ".join(f'NEW."{name}" IS NOT OLD."{name}"' for name in _FIXED)
_SQLITE = (
    f"""CREATE TRIGGER audit_update BEFORE UPDATE ON audit
    WHEN OLD.seq IS NOT NULL OR NEW.seq IS NULL OR NEW.hash IS NULL OR NEW.previous_hash IS NULL OR {_CHANGED}
    BEGIN SELECT RAISE(ABORT, '{MESSAGE}'); END""",
    f"""CREATE TRIGGER audit_delete BEFORE DELETE ON audit
    WHEN OLD.seq IS NULL OR OLD.seq > coalesce((SELECT max(pruned_seq) FROM audit_head), 0)
    BEGIN SELECT RAISE(ABORT, '{MESSAGE}'); END""",  # noqa: S608 - a constant of this module
)
_WITHOUT = "".join(f" - '{name}'" for name in _SEALED)
_POSTGRESQL = (
    f"""CREATE FUNCTION specimap_audit_guard() RETURNS trigger LANGUAGE plpgsql AS $$
    BEGIN
        IF TG_OP = 'UPDATE' THEN
            IF OLD.seq IS NULL AND NEW.seq IS NOT NULL AND NEW.hash IS NOT NULL AND NEW.previous_hash IS NOT NULL
                AND (to_jsonb(NEW){_WITHOUT}) = (to_jsonb(OLD){_WITHOUT}) THEN
                RETURN NEW;
            END IF;
        ELSIF TG_OP = 'DELETE' THEN
            IF OLD.seq <= coalesce((SELECT max(pruned_seq) FROM audit_head), 0) THEN
                RETURN OLD;
            END IF;
        END IF;
        RAISE EXCEPTION '{MESSAGE}';
    END $$""",  # noqa: S608 - constants of this module
    """CREATE TRIGGER audit_update BEFORE UPDATE ON audit
    FOR EACH ROW EXECUTE FUNCTION specimap_audit_guard()""",
    """CREATE TRIGGER audit_delete BEFORE DELETE ON audit
    FOR EACH ROW EXECUTE FUNCTION specimap_audit_guard()""",
    """CREATE TRIGGER audit_truncate BEFORE TRUNCATE ON audit
    FOR EACH STATEMENT EXECUTE FUNCTION specimap_audit_guard()""",
)
