"""What joins Specimap to a hospital: DICOM objects and their delivery, orders, FHIR, the audit trail's export."""
