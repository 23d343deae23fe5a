"""The science: four stages, formats, geometry, accuracy. No web, no queue, no database.

Layers, bottom to top; a module imports only from layers below its own::

    errors, geometry, files
    fiducials, cube, cloud, acquisition, phantom
    reconstruct, adjust, surface, render, register, accuracy
    pipeline
"""

import os

# Read once, when numpy is first imported. The matrices here are small and the stages bring threads of their own: a
# BLAS that starts more for each of them makes them wait for one another (the markers' solve takes 15 times as long
# on a busy machine).
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
