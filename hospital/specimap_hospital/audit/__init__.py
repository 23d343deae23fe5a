"""The audit trail outside of the service: DICOM audit messages, lines of JSON, a syslog server."""
