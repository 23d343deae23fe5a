"""Path-traced specimens with exact truth: slower to render than the quick phantoms, and harder to reconstruct.

Only :mod:`~specimap_validation.path_traced.settings` is free of Mitsuba, which the extra ``path-traced`` brings.
"""
