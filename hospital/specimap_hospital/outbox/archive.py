"""The archive: objects sent by STOW-RS or C-STORE, and the question whether it has one."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Protocol, Self

from specimap_hospital.connections import PeerError, association, dicomweb, entity, web_errors
from specimap_hospital.dicom.model import DicomObject
from specimap_infra.settings import ServiceSettings

if TYPE_CHECKING:
    from pynetdicom.association import Association

STORED = (0x0000, 0xB000, 0xB006, 0xB007)
"""Statuses of C-STORE: stored, perhaps with a warning."""
BUSY = range(0xA700, 0xA800)
"""Out of resources: it may take the object later."""


class Archive(Protocol):
    """A way to the archive, open for the time of a set."""

    name: str

    def send(self, made: DicomObject) -> None:
        """Send one object. Raises PeerError where it is not certain that the archive has it."""

    def has(self, made: DicomObject) -> bool:
        """Whether the archive has the object. Raises PeerError where it does not say."""


class Stow:
    """STOW-RS, and QIDO-RS to ask. One request for each object: what is refused concerns that one alone."""

    name = "stow"

    def __init__(self, settings: ServiceSettings) -> None:
        self._client = dicomweb(
            settings,
            settings.pacs_url,
            token=settings.pacs_token,
            user=settings.pacs_user,
            password=settings.pacs_password,
            seconds=settings.pacs_seconds,
        )

    def __enter__(self) -> Self:
        # Whatever it answers, it is there; that it refuses is told by the object that it refuses.
        try:
            with web_errors():
                self._client.search_for_studies(search_filters={"StudyInstanceUID": "2.25.0"}, limit=1)
        except PeerError as error:
            if error.away and error.reason not in ("http_403", "http_404"):
                raise
        return self

    def __exit__(self, *_: object) -> None:
        self._client._session.close()

    def send(self, made: DicomObject) -> None:
        """Send one object."""
        from pydicom import dcmread

        with web_errors():
            answer = self._client.store_instances([dcmread(made.path)])
            taken = {str(item.ReferencedSOPInstanceUID) for item in answer.get("ReferencedSOPSequence") or ()}
            # Of the one object that was sent, whether or not the archive can tell which one it was.
            failed = [int(item.get("FailureReason") or 0) for item in answer.get("FailedSOPSequence") or ()]
        if made.sop_instance_uid in taken:
            return
        if failed:
            raise PeerError(f"failure_{failed[0]:04x}", passing=failed[0] in BUSY)
        # Some say of what they cannot read neither that they took it nor that they did not.
        raise PeerError("not_taken", passing=False)

    def has(self, made: DicomObject) -> bool:
        """Whether QIDO-RS finds it."""
        with web_errors():
            found = self._client.search_for_instances(
                made.study_uid, made.series_uid, search_filters={"SOPInstanceUID": made.sop_instance_uid}, limit=1
            )
            return any(item["00080018"]["Value"][0] == made.sop_instance_uid for item in found)


class Store:
    """C-STORE, and C-FIND to ask, over one association."""

    name = "c-store"

    def __init__(self, settings: ServiceSettings) -> None:
        self._settings = settings
        self._stack = ExitStack()
        self._peer: Association | None = None
        self._proposed: set[tuple[str, str]] = set()

    def __enter__(self) -> Self:
        self._associate([("1.2.840.10008.1.1", "1.2.840.10008.1.2")])
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def send(self, made: DicomObject) -> None:
        """Send one object."""
        from pydicom import dcmread

        dataset = dcmread(made.path)
        syntax = str(dataset.file_meta.TransferSyntaxUID)
        peer = self._with_context(made.sop_class_uid, syntax)
        try:
            status = peer.send_c_store(dataset)
        except ValueError:
            raise PeerError("class_not_offered", passing=False) from None
        except (RuntimeError, AttributeError):
            raise PeerError("no_answer") from None
        code = status.get("Status") if status else None
        if code is None:
            raise PeerError("no_answer")
        if code not in STORED:
            raise PeerError(f"status_{code:04x}", passing=code in BUSY)

    def has(self, made: DicomObject) -> bool:
        """Whether C-FIND finds it."""
        from pydicom.dataset import Dataset
        from pynetdicom.sop_class import StudyRootQueryRetrieveInformationModelFind as Find  # type: ignore[attr-defined]

        peer = self._with_context(str(Find), "1.2.840.10008.1.2")
        asked = Dataset()
        asked.QueryRetrieveLevel = "IMAGE"
        asked.StudyInstanceUID, asked.SeriesInstanceUID = made.study_uid, made.series_uid
        asked.SOPInstanceUID = made.sop_instance_uid
        found = False
        try:
            for status, match in peer.send_c_find(asked, Find):
                code = status.get("Status") if status else None
                if code in (0xFF00, 0xFF01) and match is not None:
                    found |= match.get("SOPInstanceUID") == made.sop_instance_uid
                elif code != 0x0000:
                    raise PeerError("no_answer")
        except (ValueError, RuntimeError, AttributeError):
            raise PeerError("find_not_offered") from None
        return found

    def _with_context(self, sop_class: str, syntax: str) -> Association:
        """The association, made anew where it does not propose the class yet."""
        if (sop_class, syntax) not in self._proposed or self._peer is None or not self._peer.is_established:
            self._associate([(sop_class, syntax), *(self._proposed - {(sop_class, syntax)})])
        assert self._peer is not None
        return self._peer

    def _associate(self, contexts: list[tuple[str, str]]) -> None:
        self._stack.close()
        settings = self._settings
        ae = entity(settings, settings.pacs_seconds)
        # A context of its own for each syntax: in one with several, the archive would choose one of them.
        for sop_class, syntax in contexts[:120]:
            ae.add_requested_context(sop_class, syntax)
        made = association(
            ae, settings, settings.pacs_host, settings.pacs_port, settings.pacs_ae_title, tls=settings.pacs_tls == "on"
        )
        self._peer = self._stack.enter_context(made)
        self._proposed = set(contexts[:120])


def open_archive(settings: ServiceSettings, stack: ExitStack) -> Archive:
    """Open the way to the archive that answers: STOW-RS where it is set, else C-STORE.

    Raises:
        PeerError: none answers. SettingsError: the certificates do not read.
    """
    refused: PeerError | None = None
    if settings.pacs_url:
        try:
            return stack.enter_context(Stow(settings))
        except PeerError as error:
            refused = error
    if settings.pacs_host:
        return stack.enter_context(Store(settings))
    raise refused or PeerError("no_archive")
