"""Results as DICOM objects: files and a study context in, DICOM files out; no database, no network."""
