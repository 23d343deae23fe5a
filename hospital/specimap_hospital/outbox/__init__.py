"""The outbox: results on their way to an archive, as DICOM objects."""
