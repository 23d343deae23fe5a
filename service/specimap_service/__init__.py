"""The HTTP API: uploads, jobs, results, keys. Imports no 3D vision package."""
