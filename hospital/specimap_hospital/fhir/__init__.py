"""FHIR R4: a result as DiagnosticReport with its Observations, Specimen and ImagingStudy, posted to a server."""
