"""The science: four stages, formats, geometry, accuracy. No web, no queue, no database, no HTTP status.

Modules and packages from the bottom up; each imports only those before it::

    errors, arrays, notices, threads, progress, json_text, atomic, native
    geometry, sandbox, photos, fiducials, cube
    bundle_adjust, surface, render, cloud, reconstruct, register
    truth, report, export, screening, pipeline
"""

from importlib.metadata import version

__version__ = version("specimap")
