"""The science: four stages, formats, geometry, accuracy. No web, no queue, no database.

Layers, bottom to top; a module imports only from layers below its own::

    errors, geometry, files
    fiducials, cube, cloud, acquisition, phantom
    reconstruct, adjust, surface, render, register, accuracy
    pipeline
"""
