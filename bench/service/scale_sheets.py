"""Tables of what the service does with a full queue."""

from __future__ import annotations

from typing import Any

from bench.service.databases import NO_POSTGRES
from bench.service.scale import API_CLIENTS, NAMES, WORKERS
from bench.service.sheet import NONE, Sheet, reached

TARGET_MS = 100.0
POLLS_TARGET = 1.0
USUAL_CONNECTIONS = 100
"""Connections that PostgreSQL allows by default; three of them to its administrator only."""


def sheet_scale(figures: dict[str, Any]) -> list[Sheet]:
    """Waits on both databases, then what workers take."""
    runs = figures["runs"]
    waits = Sheet(
        f"{figures['jobs']:,} queued jobs and {figures['acquisitions']:,} acquisitions, one client, ms, worst run",
        ("", "PostgreSQL p50", "p99", "wanted", "met", "API CPU", "SQLite p50", "p99"),
    )
    for name, words in NAMES.items():
        cells: list[str] = []
        for kind in ("postgresql", "sqlite"):
            found = runs.get(kind, {}).get(name)
            p50, p99 = (max(run[p] for run in found) for p in ("p50_ms", "p99_ms")) if found else (None, None)
            cells += [NONE if value is None else f"{value:.1f}" for value in (p50, p99)]
            if kind == "postgresql":
                met = NONE if p99 is None else reached(p99, TARGET_MS, least=False)
                cpu = [run["cpu_ms"] for run in found or () if "cpu_ms" in run]
                cells += [f"<= {TARGET_MS:.0f}", met, f"{min(cpu):.1f}" if cpu else NONE]
        waits.rows.append((words, *cells))
    waits.notes.append("API CPU: processor time of the API for a request on PostgreSQL, the least of all runs.")
    if "crowds" not in figures:
        waits.notes.append(NO_POSTGRES)
        return [waits]
    return [waits, _crowd_sheet(figures), _limit_sheet(figures)]


def _crowd_sheet(figures: dict[str, Any]) -> Sheet:
    sheet = Sheet(
        "Workers without stages at one PostgreSQL, and a client of the API beside them, p99 ms",
        ("workers", "claims a second", "claim", "event written", "list", "submission", "errors"),
    )
    for name, crowd in figures["crowds"].items():
        pace = "claim as fast as they can" if name.startswith("storm") else "a job of 10 s each, an event a second"
        sheet.rows.append(
            (
                f"{crowd['claimers']}: {pace}",
                f"{crowd['claims_per_second']:.0f}",
                f"{crowd['claim']['p99_ms']:.0f}",
                f"{crowd['event']['p99_ms']:.0f}" if crowd["event"] else NONE,
                f"{crowd['list']['p99_ms']:.0f}",
                f"{crowd['submit']['p99_ms']:.0f}",
                str(sum(crowd["errors"].values())),
            )
        )
    sheet.notes.append("Workers, API, client and server share the cores.")
    return sheet


def _limit_sheet(figures: dict[str, Any]) -> Sheet:
    idle, usual = figures["idle"], USUAL_CONNECTIONS
    workers = (usual - 3 - figures["api_connections"]) // idle["connections"]
    polls = idle["polls_per_second"]
    sheet = Sheet("What processes take of one PostgreSQL", ("", "figure", "wanted", "met"))
    sheet.rows += [
        ("connections that an idle worker holds", str(idle["connections"]), NONE, NONE),
        (
            f"connections that an API holds under {API_CLIENTS} clients",
            str(figures["api_connections"]),
            NONE,
            NONE,
        ),
        (
            "polls of an idle worker a second",
            f"{polls:.1f}",
            f"<= {POLLS_TARGET:.0f}",
            reached(polls, POLLS_TARGET, least=False),
        ),
        (
            "its transactions a second, with those of its lease",
            f"{idle['transactions_per_second']:.1f}",
            NONE,
            NONE,
        ),
        (f"idle workers beside one API until `max_connections = {usual}` is used up", str(workers), NONE, NONE),
        (f"connections of {WORKERS} idle workers", str(WORKERS * idle["connections"]), NONE, NONE),
    ]
    sheet.notes.append(
        f"PostgreSQL {figures['postgres_version']}, which was measured with `max_connections = "
        f"{figures['max_connections']}`; {usual} is its default."
    )
    return sheet
