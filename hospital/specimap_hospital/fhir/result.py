"""What a result's bundle tells: its study context, its figures, and its objects in the archive."""

from __future__ import annotations

from collections.abc import Callable

from specimap_core import __version__
from specimap_core.errors import NotFoundError
from specimap_core.report.model import Report
from specimap_core.report.wording import verdict
from specimap_hospital.dicom.model import DicomObject
from specimap_hospital.fhir.bundle import Result, SentInstance, transaction
from specimap_hospital.fhir.elements import Element, Systems
from specimap_hospital.outbox.making import make_objects
from specimap_hospital.outbox.workspaces import workspace
from specimap_infra.database import Database
from specimap_infra.errors import StudyMissingError
from specimap_infra.settings import ServiceSettings
from specimap_infra.storage import Storage
from specimap_infra.studies import find_study, study_keys
from specimap_infra.tables import Acquisition, CloudRow


def bundle_maker(
    database: Database, storage: Storage, settings: ServiceSettings, cancelled: Callable[[], bool] = lambda: False
) -> Callable[[str], Element]:
    """Return what makes the bundle of a cloud by its id.

    It raises what :func:`~specimap_hospital.outbox.making.make_objects` and
    :func:`~specimap_hospital.fhir.bundle.transaction` raise: the figures are those of the structured report, which is
    made again as the archive has it.
    """
    systems = Systems(settings.fhir_patient_system, settings.fhir_accession_system, settings.fhir_specimen_system)

    def make(cloud_id: str) -> Element:
        with database.session() as session:
            row = session.get(CloudRow, cloud_id)
            if row is None:
                raise NotFoundError(f"There is no cloud {cloud_id}.", advice="It was deleted.")
            acquisition = session.get_one(Acquisition, row.acquisition_id)
            study = find_study(session, study_keys(settings), row.acquisition_id)
        if study is None:
            raise StudyMissingError("The acquisition has no study context any more.", advice="PUT one.")
        report = Report.model_validate(row.report)
        with workspace(settings.scratch) as folder:
            made = make_objects(database, storage, settings, cloud_id, {}, folder, cancelled=cancelled)
            result = _told(made, row, acquisition, report, settings)
            return transaction(study.context, result, systems)

    return make


def _told(
    made: list[DicomObject], row: CloudRow, acquisition: Acquisition, report: Report, settings: ServiceSettings
) -> Result:
    from pydicom import dcmread

    measurements = next(item for item in made if item.kind == "measurements")
    picture = dcmread(next(item for item in made if item.kind == "top_view").path, stop_before_pixels=True)
    instances = [
        SentInstance(
            item.series_uid,
            item.sop_instance_uid,
            item.sop_class_uid,
            str(dcmread(item.path, stop_before_pixels=True, specific_tags=["Modality"]).Modality),
        )
        for item in (made if settings.sends_dicom else ())
    ]
    judged = verdict(report)
    address = settings.public_url.rstrip("/")
    return Result(
        cloud_id=row.id,
        specimen_id=acquisition.specimen_id,
        captured_at=acquisition.created_at,
        finished_at=row.created_at,
        software_version=__version__,
        verdict=" ".join((judged.title, *judged.actions)),
        study_uid=measurements.study_uid,
        specimen_uid=str(picture.SpecimenDescriptionSequence[0].SpecimenUID),
        report=dcmread(measurements.path),
        instances=instances,
        links=[f"{address}/#/view/{row.id}"] if address else [],
    )
