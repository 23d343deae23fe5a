"""The audit trail at a real syslog server, across outages and restarts, and its audit messages."""

from __future__ import annotations

import base64
import itertools
import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from lxml import etree

from specimap_core.errors import SpecimapError
from specimap_hospital.audit.event_codes import event_of
from specimap_hospital.audit.forwarder import AuditForwarder
from specimap_hospital.audit.messages import Source, dicom_message, json_line
from specimap_hospital.audit.reading import all_sealed, sealed_after
from specimap_infra.audit.records import ChainKeys
from specimap_infra.audit.sealing import seal
from specimap_infra.database import Database, utc_now
from specimap_infra.errors import SyslogUnavailableError
from specimap_infra.settings import ServiceSettings, load_settings
from specimap_infra.tables import AuditCursor, AuditEntry
from tests.support.places import ROOT
from tests.support.syslog_server import Rsyslog

SCHEMA = etree.RelaxNG(etree.parse(ROOT / "tests" / "support" / "audit_message.rng"))


def add(database: Database, count: int, **given: Any) -> None:
    values: dict[str, Any] = {
        "key_id": "key_1",
        "project_id": "p",
        "action": "clouds.get",
        "target": "cloud_1",
        "details": {"n": 1},
    }
    values |= {"correlation_id": "c", "kind": "access", "status": 200, **given}
    with database.session() as session:
        session.add_all(AuditEntry(**values) for _ in range(count))


@pytest.fixture(params=["tls", "tls gtls", "tcp", "udp"])
def server(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Rsyslog]:
    running = Rsyslog(tmp_path / "rsyslog", *request.param.split())
    running.start()
    yield running
    running.stop()


@pytest.fixture
def secure(tmp_path: Path) -> Iterator[Rsyslog]:
    running = Rsyslog(tmp_path / "rsyslog", "tls")
    yield running
    running.stop()


def settings_for(server: Rsyslog, folder: Path, **given: object) -> ServiceSettings:
    return load_settings(data_dir=folder, audit_syslog=server.address, audit_syslog_ca=server.ca, **given)


def test_a_syslog_server_gets_audit_messages(server: Rsyslog, sqlite_tables: Database, tmp_path: Path) -> None:
    add(sqlite_tables, 3)
    forwarder = AuditForwarder(sqlite_tables, settings_for(server, tmp_path, audit_source="ward-7", audit_site="site"))
    assert forwarder.step() == 3
    assert forwarder.step() == 0
    lines = server.wait_for(3)
    assert len(lines) == 3
    for seq, line in enumerate(lines, 1):
        priority, program, kind, text = line.split(" ", 3)
        assert (priority, program, kind) == ("85", "specimap", "DICOM+RFC3881")
        message = etree.fromstring(text.lstrip("\ufeff"))
        SCHEMA.assertValid(message)
        details = {d.get("type"): d.get("value") for d in message.iter("ParticipantObjectDetail")}
        assert base64.b64decode(str(details["seq"])).decode() == str(seq)
        source = message.find("AuditSourceIdentification")
        assert source is not None
        assert (source.get("AuditSourceID"), source.get("AuditEnterpriseSiteID")) == ("ward-7", "site")


def test_an_outage_loses_nothing_and_a_restart_goes_on(secure: Rsyslog, tables: Database, tmp_path: Path) -> None:
    settings = settings_for(secure, tmp_path, audit_syslog_format="json")
    secure.start()
    add(tables, 4)
    assert AuditForwarder(tables, settings).step() == 4
    secure.stop()
    add(tables, 700)
    forwarder = AuditForwarder(tables, settings)
    for _ in range(2):
        with pytest.raises(SyslogUnavailableError):
            forwarder.step()
    secure.start()
    # Another program, as after a restart: the cursor is in the database.
    again = AuditForwarder(tables, settings)
    assert [again.step(), again.step(), again.step()] == [500, 200, 0]
    lines = [json.loads(line.split(" ", 3)[3].lstrip("\ufeff")) for line in secure.wait_for(704)]
    assert [line["seq"] for line in lines] == list(range(1, 705))
    with tables.session() as session:
        assert session.scalars(sa.select(AuditCursor.seq)).all() == [704]


def test_a_server_that_is_killed_while_it_reads_gets_the_batch_again(
    secure: Rsyslog, sqlite_tables: Database, tmp_path: Path
) -> None:
    settings = settings_for(secure, tmp_path, audit_syslog_format="json")
    secure.start()
    assert secure.process is not None
    # It is stopped before it reads, so the batch lies in its buffers when it dies.
    secure.process.send_signal(19)
    add(sqlite_tables, 5)
    faults: list[SpecimapError] = []

    def step() -> None:
        try:
            AuditForwarder(sqlite_tables, settings).step()
        except SpecimapError as error:
            faults.append(error)

    sending = threading.Thread(target=step)
    sending.start()
    sending.join(1.0)
    secure.process.kill()
    secure.process.wait(10)
    sending.join(20)
    assert [type(fault) for fault in faults] == [SyslogUnavailableError]
    secure.start()
    assert AuditForwarder(sqlite_tables, settings).step() == 5
    assert len(secure.wait_for(5)) == 5


def test_a_server_with_an_unknown_certificate_gets_nothing(
    secure: Rsyslog, sqlite_tables: Database, tmp_path: Path
) -> None:
    secure.start()
    add(sqlite_tables, 1)
    other = Rsyslog(tmp_path / "other", "tls")
    settings = load_settings(data_dir=tmp_path, audit_syslog=secure.address, audit_syslog_ca=other.ca)
    with pytest.raises(SyslogUnavailableError):
        AuditForwarder(sqlite_tables, settings).step()
    assert secure.received() == []


def test_a_forwarder_runs_until_it_is_stopped(secure: Rsyslog, sqlite_tables: Database, tmp_path: Path) -> None:
    stop = threading.Event()
    forwarder = AuditForwarder(sqlite_tables, settings_for(secure, tmp_path))
    thread = threading.Thread(target=forwarder.run, args=[stop])
    add(sqlite_tables, 2)
    # The first tries fail.
    thread.start()
    stop.wait(0.5)
    secure.start()
    add(sqlite_tables, 3)
    assert len(secure.wait_for(5)) == 5
    stop.set()
    thread.join(10)
    assert not thread.is_alive()


# ---- messages -----------------------------------------------------------------------------------------

ACTIONS = {
    ("service.start", None): ("110100", "E", "110120"),
    ("service.stop", None): ("110100", "E", "110121"),
    ("audit.list", 200): ("110101", "R", None),
    ("session.create", None): ("110114", "E", "110122"),
    ("session.delete", None): ("110114", "E", "110123"),
    ("jobs.list", 401): ("110114", "E", "110122"),
    ("acquisitions.list", 200): ("110112", "E", None),
    ("acquisitions.get", 200): ("110103", "R", None),
    ("acquisition.create", None): ("110103", "C", None),
    ("acquisition.delete", None): ("110105", "D", None),
    ("label.put", None): ("110103", "C", None),
    ("file.create", None): ("110107", "C", None),
    ("files.get_content", 200): ("110103", "R", None),
    ("export.create", None): ("110106", "C", None),
    ("exports.get_content", 200): ("110106", "R", None),
    ("key.create", None): ("110113", "C", "110137"),
    ("share.revoke", None): ("110113", "D", "110135"),
    ("zarr.get", 200): ("110103", "R", None),
    ("delivery.create", None): ("110104", "C", None),
    ("several", 404): ("110103", "R", None),
}


@pytest.mark.parametrize(("given", "expected"), ACTIONS.items(), ids=lambda value: str(value[0]))
def test_actions_are_events_of_the_standard(
    sqlite_tables: Database, given: tuple[str, int | None], expected: tuple[str, str, str | None]
) -> None:
    action, status = given
    event = event_of(action, status)
    assert (event.id.value, event.action, event.types[0].value if event.types else None) == expected
    outcome = "success" if status in (None, 200) else "refused"
    for actor, address in (("key_1", "203.0.113.9"), ("", "5d1f0a6c7be94832"), ("service", "")):
        add(
            sqlite_tables,
            1,
            action=action,
            status=status,
            key_id=actor,
            address=address,
            outcome=outcome,
            target="" if action == "several" else 'cloud_<&">é',
            acquisition_id="acq_1",
        )
    seal(sqlite_tables, ChainKeys())
    for entry in sealed_after(sqlite_tables, 0):
        message = etree.fromstring(dicom_message(entry, Source("specimap")))
        SCHEMA.assertValid(message)
        event_part = message.find("EventIdentification")
        assert event_part is not None
        assert event_part.get("EventOutcomeIndicator") == ("0" if outcome == "success" else "4")
        # RFC 3881: one participant began it.
        assert [p.get("UserIsRequestor") for p in message.iter("ActiveParticipant")].count("true") == 1
        ids = [p.get("ParticipantObjectID") for p in message.iter("ParticipantObjectIdentification")]
        assert "acq_1" in ids


def test_a_wrong_message_does_not_validate() -> None:
    message = etree.fromstring('<AuditMessage><EventIdentification EventActionCode="X"/></AuditMessage>')
    assert not SCHEMA.validate(message)


def test_lines_of_json_hold_the_chain(sqlite_tables: Database) -> None:
    begin = utc_now()
    add(sqlite_tables, 1200)
    seal(sqlite_tables, ChainKeys())
    lines = [json.loads(json_line(entry)) for entry in all_sealed(sqlite_tables, begin)]
    assert [line["seq"] for line in lines] == list(range(1, 1201))
    assert all(after["previous_hash"] == before["hash"] for before, after in itertools.pairwise(lines))
    assert list(all_sealed(sqlite_tables, utc_now())) == []
