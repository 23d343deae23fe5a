"""The HTTP API: uploads, jobs, results, keys. Pulls no 3D vision package."""
