"""Warnings about the photos, the scale and the cube's markers, for the report of a run."""

from __future__ import annotations

from specimap_core.bundle_adjust.adjust import Adjusted
from specimap_core.errors import MarkersMissingInCubeError
from specimap_core.fiducials.layout import edge_lengths
from specimap_core.notices import Notice, Notices
from specimap_core.photos.reading import RECOMMENDED_PHOTOS
from specimap_core.pipeline.artefacts import Stage1
from specimap_core.pipeline.scale_check import PLAUSIBLE_DISTANCE_MM, disagrees, likely_unit, reach_mm
from specimap_core.register.cube_markers import CubeMarkers

# What may have turned the cube's picture into another: axes, byte order, size and choice of the array.
_ASSUMPTIONS = ("axes_assumed", "byte_order_assumed", "data_longer_than_header", "dataset_chosen")


def with_assumptions(error: MarkersMissingInCubeError, warnings: Notices) -> MarkersMissingInCubeError:
    """The refusal with what the reader assumed about the file, which may be the reason; else as it is.

    ``warnings`` are the cube's.
    """
    assumed = [warning.message for warning in warnings if warning.code in _ASSUMPTIONS]
    if not assumed:
        return error
    return MarkersMissingInCubeError(
        " ".join([error.message, *assumed]),
        advice=f"First check that, which makes another picture of the cube where it is wrong. Else: {error.advice}",
        **error.details,
    )


def run_warnings(stage1: Stage1, adjusted: Adjusted, found: CubeMarkers) -> list[Notice]:
    """Those of stage 1, and those that the adjusted cameras and the markers ``found`` in the cube call for."""
    warnings = list(stage1.reconstruction.warnings)
    used = len(stage1.reconstruction.photos)
    if used < RECOMMENDED_PHOTOS:
        warnings.append(Notice("few_photos", f"{used} photos were used; {RECOMMENDED_PHOTOS} or more are recommended."))
    missing = sorted(set(adjusted.marker_ids) - set(found.marker_ids))
    if missing and len(adjusted.marker_ids) <= 8:
        text = f"Marker {', '.join(map(str, missing))} does not show in the cube: {4 * len(found.marker_ids)} "
        warnings.append(Notice("markers_missing_in_cube", text + "correspondences are left."))
    if found.where != "band mean":
        warnings.append(Notice("markers_not_in_band_mean", f"The markers show best in the {found.where}."))
    if found.mirrored:
        warnings.append(
            Notice(
                "cube_mirrored", "The cube is mirrored, as its markers show; columns were counted from the other side."
            )
        )
    reach = reach_mm(adjusted.poses, adjusted.corners)
    if not PLAUSIBLE_DISTANCE_MM[0] < reach < PLAUSIBLE_DISTANCE_MM[1]:
        warnings.append(
            Notice(
                "scale_implausible",
                f"With this marker edge the photos were taken {reach:.0f} mm from the markers"
                f"{likely_unit(edge_lengths(adjusted.corners).mean(), reach)}.",
            )
        )
    if disagrees(reach, stage1.subject_mm):
        warnings.append(
            Notice(
                "scale_contradicts_exif",
                f"The photos' EXIF says {stage1.subject_mm:.0f} mm to the subject, the marker edge "
                f"{reach:.0f} mm: check the edge.",
            )
        )
    return warnings
