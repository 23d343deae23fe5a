"""DICOM objects that come in: classifiers' segmentations, photos, an archive's commitment."""
