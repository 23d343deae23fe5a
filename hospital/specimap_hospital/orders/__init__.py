"""Orders of the hospital, looked up by accession number, patient or station."""
