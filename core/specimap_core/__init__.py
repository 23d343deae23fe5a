"""The science: four stages, formats, geometry, accuracy. No web, no queue, no database, no HTTP status.

Packages, bottom to top; a package imports only from those above it in this list and from its own row::

    errors, atomic, native, progress, json_text
    geometry, sandbox
    photos, fiducials, cube
    bundle_adjust, surface, render, cloud
    reconstruct, register
    truth, report, export, screening
    pipeline
"""

import os
from importlib.metadata import version

__version__ = version("specimap")

# Read once, when numpy is first imported. The matrices here are small and the stages bring threads of their own: a
# BLAS that starts more for each of them makes them wait for one another (the markers' solve takes 15 times as long
# on a busy machine).
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
