"""Client of a Specimap service: upload, run, read spectra, write labels.

::

    from specimap_client import Client

    with Client("https://specimap.example", key) as client:
        acquisition = client.acquisitions.create("S26-1042")
        files = client.acquisitions.upload(acquisition, photos=photos, cube="scan.hdr")
        job = client.jobs.wait(client.jobs.submit(acquisition))
        cloud = client.clouds.get(job.cloud_id)
        spectra = cloud.spectra(radius=((3.0, -2.0, 8.0), 1.5), nm=(500, 600))

All errors are :class:`SpecimapClientError`; see ``specimap_client._errors`` for their tree. Names that begin with an
underscore are private.
"""

from specimap_client._client import Client
from specimap_client._clouds import Cloud
from specimap_client._errors import (
    ApiError,
    Conflict,
    ConnectionFailed,
    ExportFailed,
    Forbidden,
    JobFailed,
    MissingExtra,
    NotConfigured,
    NotFound,
    RateLimited,
    Refused,
    ServerError,
    SpecimapClientError,
    Timeout,
    Unauthorized,
    UnexpectedAnswer,
    UploadFailed,
)
from specimap_client._labels import Label, LabelClass
from specimap_client._models import (
    Acquisition,
    Event,
    Export,
    Failure,
    File,
    Job,
    Key,
    LogLine,
    NewKey,
    Point,
    Progress,
    Project,
)
from specimap_client._report import Report
from specimap_client._retries import Retries
from specimap_client._shares import NewShare, Share
from specimap_client._spectra import Spectra
from specimap_client._version import __version__

__all__ = [
    "Acquisition",
    "ApiError",
    "Client",
    "Cloud",
    "Conflict",
    "ConnectionFailed",
    "Event",
    "Export",
    "ExportFailed",
    "Failure",
    "File",
    "Forbidden",
    "Job",
    "JobFailed",
    "Key",
    "Label",
    "LabelClass",
    "LogLine",
    "MissingExtra",
    "NewKey",
    "NewShare",
    "NotConfigured",
    "NotFound",
    "Point",
    "Progress",
    "Project",
    "RateLimited",
    "Refused",
    "Report",
    "Retries",
    "ServerError",
    "Share",
    "SpecimapClientError",
    "Spectra",
    "Timeout",
    "Unauthorized",
    "UnexpectedAnswer",
    "UploadFailed",
    "__version__",
]
