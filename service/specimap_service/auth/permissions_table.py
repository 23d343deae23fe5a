"""``python -m specimap_service.auth.permissions_table``: print the tables of docs/identity.md, made from the table of
permissions."""

from __future__ import annotations

from specimap_service.auth.permissions import (
    EQUIVALENT,
    MEANINGS,
    OPERATIONS,
    ROLES,
    SCOPE_PERMISSIONS,
    roles_for,
)


def page_part() -> str:
    """All tables, as docs/identity.md holds them."""
    return f"{_permissions()}\n\n{_roles()}\n\n{_operations()}"


def _permissions() -> str:
    lines = [
        "| permission | permits, within the projects that are seen | roles | scopes of keys |",
        "|---|---|---|---|",
    ]
    for name, meaning in MEANINGS.items():
        scopes = [scope for scope, held in SCOPE_PERMISSIONS.items() if name in held]
        lines.append(f"| `{name}` | to {meaning} | {', '.join(roles_for(name))} | {_code(scopes)} |")
    return "\n".join(lines)


def _roles() -> str:
    lines = ["| role | permissions | a key for the same work |", "|---|---|---|"]
    for role, held in ROLES.items():
        names = "all" if held == frozenset(MEANINGS) else _code([name for name in MEANINGS if name in held])
        lines.append(f"| {role} | {names} | {_code(EQUIVALENT[role])} |")
    return "\n".join(lines)


def _operations() -> str:
    lines = ["| permission | operations, by their ids in openapi.yaml |", "|---|---|"]
    for permission in (*MEANINGS, None):
        names = sorted(name for name, needed in OPERATIONS.items() if needed == permission)
        if names:
            lines.append(f"| {'none' if permission is None else f'`{permission}`'} | {_code(names)} |")
    return "\n".join(lines)


def _code(names: list[str] | tuple[str, ...]) -> str:
    return ", ".join(f"`{name}`" for name in names)


if __name__ == "__main__":
    print(page_part())
