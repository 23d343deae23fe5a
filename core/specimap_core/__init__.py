"""The science: four stages, formats, geometry, accuracy. No web, no queue, no database, no HTTP status.

Packages, bottom to top; a package imports only from those above it in this list and from its own row::

    errors, atomic, native, threads, progress, json_text
    geometry, sandbox
    photos, fiducials, cube
    bundle_adjust, surface, render, cloud
    reconstruct, register
    truth, report, export, screening
    pipeline
"""

from importlib.metadata import version

__version__ = version("specimap")
