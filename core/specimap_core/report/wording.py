"""Words for the figures: the verdict, the checks, and advice on each warning and refused photo."""

from __future__ import annotations

import math
from dataclasses import dataclass

from specimap_core.notices import few_of
from specimap_core.photos.reading import RECOMMENDED_PHOTOS
from specimap_core.report.blocks import Level
from specimap_core.report.model import Report
from specimap_core.report.photo_figures import LIMIT_MM
from specimap_core.report.quality_gates import LEAST_COVERAGE, MOST_CUBE_RMS_PX, corner_limit_px, outlying_photos

MOST_REFUSED = 2
LAYOUT_MARKERS = 8
"""Up to so many markers, all should show in the cube; of a whole board, four suffice."""

WARNING_ADVICE = {
    "few_photos": f"Take {RECOMMENDED_PHOTOS} or more photos from all around; the errors then become smaller.",
    "scale_implausible": "Measure the print with a calliper and give the edge of the black square in millimetres.",
    "scale_contradicts_exif": "Measure the black edge of a printed marker and compare it with the edge that was given.",
    "markers_missing_in_cube": "Record the cube again with all markers in view, lit, in focus and uncovered.",
    "markers_not_in_band_mean": "Nothing, where the corners in the cube fit; else light the markers better.",
    "cube_mirrored": "Nothing for this result. Have the camera's software export cubes that are not mirrored.",
    "single_band": "Check the export: a cube of one band carries no spectra.",
    "bands_all_zero": "Leave these bands out of any analysis.",
    "pixels_nan": "Leave these pixels out of any analysis; record the cube again if they lie on the specimen.",
    "values_nan": "Leave these values out of any analysis.",
    "points_no_data": "Leave points with the flag 128 out of any analysis, or the bands in which they lack a value.",
    "values_clipped": "Nothing, if these are glints or dead pixels; else check scale and offset in the cube's file.",
    "pixels_zero": "Leave these pixels out of any analysis; name zero as no-data value when exporting the cube.",
    "no_data_impossible": "Correct the no-data value in the cube's file; check whether another value stands for none.",
    "no_data_undeclared": "Export the cube again with its no-data value in the header.",
    "values_absurd": "Have dead pixels corrected in the camera's software; their points are flagged.",
    "detector_dead": "Have dead detector elements corrected in the camera's software; their points are flagged.",
    "scale_assumed": "Check that reflectance lies between 0 and 1; else correct the scale in the cube's file.",
    "reflectance_factor_unused": "Correct the reflectance scale factor in the cube's file.",
    "reflectance_implausible": "Check scale factor and offset in the cube's file before reading any spectrum.",
    "quantity_not_reflectance": "Give a white frame of the same kind, or a cube of reflectance, where that is needed.",
    "reference_units_differ": "Give cube, white and dark frame alike: all as counts of the same export.",
    "reference_exposure_differs": "Record cube and references with one exposure, or bring their counts to one first.",
    "white_wavelengths_differ": "Give the white frame that was recorded with this cube and the same bands.",
    "dark_wavelengths_differ": "Give the dark frame that was recorded with this cube and the same bands.",
    "white_saturated": "Record the white frame again with a shorter exposure: reflectance is too high where it clips.",
    "saturated": "Expose the cube shorter: saturated pixels are flagged and carry no true spectrum.",
    "wavelengths_missing": "Export the cube with its wavelengths; bands are known by number only.",
    "wavelengths_count_mismatch": "Export the cube again: its header names more or fewer wavelengths than bands.",
    "wavelengths_invalid": "Export the cube again with wavelengths in nm that rise from band to band.",
    "wavelengths_band_numbers": "Export the cube with its wavelengths; bands are known by number only.",
    "wavelengths_implausible": "Correct the wavelengths or their unit in the cube's file.",
    "wavelength_units_contradict": "Correct the wavelengths' unit in the cube's file; check that they came out right.",
    "wavelength_units_unknown": "Write the wavelengths' unit as nm or um; check that they came out right.",
    "wavelengths_repeated": "Check the wavelengths in the cube's file before looking a band up by its wavelength.",
    "wavelengths_unordered": "Check the wavelengths in the cube's file; software that joins bands may expect an order.",
    "values_lossy": "Save the cube uncompressed, or with LZW, Deflate or ZSTD.",
    "dataset_chosen": "Check that the array that was taken is the cube; else name the other one.",
    "bad_bands_count_mismatch": "Export the cube again: its list of bad bands does not fit its bands.",
    "bad_bands_all": "Check the header: it calls every band bad.",
    "dark_missing": "Give a dark frame too; without it reflectance is a little too high where little light comes back.",
    "reference_invalid": "Give the white and dark frames that belong to this cube.",
    "byte_order_assumed": "Look whether the spectra are plausible; export the cube with its byte order.",
    "axes_assumed": "Look whether the picture is that of the specimen; export the cube with named axes.",
    "data_longer_than_header": "Check the export: the file holds more than its header says.",
    "focal_breathing": "Nothing for this result. Lock the focus while taking photos, where the camera can.",
    "features_chosen": "Show two or more markers in every photo; poses from markers are the more exact ones.",
    "marker_moved": "Look at that marker: if it was moved or covered, photograph and record again.",
    "specimen_moved": "Check the preview against the specimen; if in doubt, photograph and record again, untouched.",
    "cube_camera_loose": "Show all four markers in the cube, sharper if you can, or tilt the camera a little.",
    "cube_pixels_not_square": "Nothing for this result. Match the scanner's speed to its pixels, where it can be set.",
    "cube_camera_not_frame": "Nothing: it says how the cube was recorded.",
    "cube_camera_unfit": "Record the cube again at an even speed, and touch nothing between photos and cube.",
    "dense_on_gpu": "Nothing: it says where depth was measured.",
    "dense_gpu_failed": "Nothing: it says where depth was measured.",
    "backend_run": "Nothing: keep it with the result, so that it can be repeated.",
    "depth_unaligned": "Show two or more markers in the photos that are named, or run the default backend.",
    "coverage_low": "Take more photos, also from the side that is missing in the coverage map, sharp and evenly lit.",
    "specimen_not_found": "Check that the specimen lies between the markers and higher than they do.",
    "corners_scatter": "Take all photos again, touching neither markers nor specimen in between, with one lens.",
    "photo_outlying": "Look at the photos that are named: a card moved, or another lens. Take them again.",
    "cube_corners_scatter": "Record the cube again: all markers unmoved, sharp, and the sensor's pixels square.",
    "photos_contradict": "Take all photos again, touching neither specimen nor markers, with one lens and fixed focus.",
    "photo_contradicts": "Leave out the photos that are named, or take them again, and repeat the run.",
    "photos_unpredicted": "Take the photos again, sharp, evenly lit and without glare; then repeat the run.",
    "surface_leans": "Take all photos again with one lens and fixed focus; check the edge of the markers.",
    "surface_unchecked": f"Take {RECOMMENDED_PHOTOS} or more photos from all around: some must be left for checking.",
    "seen_error_large": "Take more and sharper photos, evenly lit; rely on no place more closely than sigma_mm says.",
    "cube_picture_off": "Check the preview against the specimen; if in doubt, photograph and record again, untouched.",
    "bands_shifted": "Have the camera's software register the bands, or compare spectra over several pixels only.",
    "files_passed_over": "Nothing, where none of them is a photo of this specimen; else put it beside the others.",
    "licence_apache": "Nothing: the licence allows any use.",
    "licence_non_commercial": "Use this result for no commercial purpose; run the default backend for any other.",
}
UNKNOWN_WARNING_ADVICE = "Read it before using the result; the documentation of errors and warnings says more."

REFUSAL_ADVICE = {
    "photo_unreadable": "Copy the photo again, or take it again.",
    "photo_raw": "Export it as JPEG, with the same settings as the others.",
    "photo_duplicate": "Nothing: the same photo is used once.",
    "photo_blurred": "Take it again from the same side: tap to focus, hold still.",
    "photo_foreign": "Leave it out if it shows something else; else show the markers in it.",
    "photo_unlocated": "Take it again with two or more markers in view, between its neighbours.",
    "photo_ambiguous": "Take it again with two or more markers in view, between its neighbours.",
}
GRAVE = (
    "specimen_moved",
    "cube_camera_loose",
    "cube_camera_unfit",
    "scale_implausible",
    "scale_contradicts_exif",
    "specimen_not_found",
    "corners_scatter",
    "cube_corners_scatter",
    "photos_contradict",
    "photos_unpredicted",
    "surface_leans",
    "seen_error_large",
    "cube_picture_off",
)
"""Warnings that put all places in doubt."""
UNKNOWN_REFUSAL_ADVICE = "Take it again from the same side with the markers in view."

MEANINGS = (
    (
        "2D corner error",
        "Where the registration puts the cube's corners, against the adjusted corners, in the plane.",
        "How it would be elsewhere: the fit was made on the same corners, and they all lie near one plane.",
    ),
    (
        "3D corner error",
        "The same against the surface under each corner.",
        "Whether that surface is true: it is this run's own reconstruction, of paper, not of tissue.",
    ),
    (
        "Leaving a marker out",
        "The registration fitted without a marker, measured on it.",
        "How it is above the markers' plane.",
    ),
    (
        "Marker edge",
        "Edges of corners triangulated one by one, against the known edge.",
        "Whether the known edge is true: a wrong one makes everything larger or smaller.",
    ),
    (
        "Between the two methods",
        "How far apart the two methods put the specimen's pixels.",
        "Which of them is right.",
    ),
    (
        "Stated sigma",
        "What this run states as the standard deviation of the position of the specimen's points.",
        "Whether it is so: it is an estimate, which only truth can confirm.",
    ),
)
"""Each figure, what it says, and what it cannot say; docs/accuracy.md."""


@dataclass(frozen=True)
class Check:
    """One thing that must be right: what was found, what is wanted, and what to do where it is not."""

    name: str
    found: str
    wanted: str
    good: bool
    action: str


def checks(report: Report) -> list[Check]:
    """The lines that docs/surgeon-imaging.md tells to look at."""
    photos, left = report.photos, report.leave_one_marker_out_mm
    refused = photos.given - len(photos.used)
    in_photos, in_cube = report.marker_ids, report.marker_ids_in_cube
    missing = sorted(set(in_photos) - set(in_cube))
    of_a_board = len(in_photos) > LAYOUT_MARKERS
    covered = report.coverage.between_markers
    rms, off, cube = report.reprojection_px.after, outlying_photos(report), report.cube_camera.reprojection_rms_px
    return [
        Check(
            "Photos used",
            f"{len(photos.used)} of {photos.given}",
            f"all but {MOST_REFUSED}",
            refused <= MOST_REFUSED,
            "Take the photos that were not used again: " + few_of([r.name for r in photos.refused]) + ".",
        ),
        Check(
            "Markers in the cube",
            f"{len(in_cube)} of {len(in_photos)}",
            "4 or more" if of_a_board else "all that the photos show",
            len(in_cube) >= 4 if of_a_board else not missing,
            "Record the cube again with four or more markers in view, lit and uncovered."
            if of_a_board
            else f"Record the cube again with marker {few_of([str(i) for i in missing])} in view, lit and uncovered.",
        ),
        Check(
            "Corners in the photos",
            f"{rms:.2f} px" + (f"; {len(off)} photo{'s' * (len(off) != 1)} off" if off else ""),
            f"{corner_limit_px(report):.1f} px or less, no photo far off",
            rms <= corner_limit_px(report) and not off,
            f"Look at {few_of([o.name for o in off])}: a card moved in between, or it is of another lens."
            if off
            else "Take all photos again with one lens, touching neither markers nor specimen in between.",
        ),
        Check(
            "Corners in the cube",
            f"{cube:.2f} px",
            f"{MOST_CUBE_RMS_PX:.1f} px or less",
            cube <= MOST_CUBE_RMS_PX,
            "Record the cube again, with markers unmoved and sharp.",
        ),
        Check(
            "Leaving a marker out",
            "too few markers to tell" if left is None else f"{left.median:.3f} mm, largest {left.maximum:.3f} mm",
            f"median below {LIMIT_MM:g} mm",
            left is not None and left.median < LIMIT_MM,
            "Show three or more markers in the cube."
            if left is None
            else "Something moved between photos and cube, or the marker's edge is wrong: check both and repeat.",
        ),
        Check(
            "Coverage between the markers",
            f"{100 * covered:.1f} %",
            f"above {100 * LEAST_COVERAGE:.0f} %",
            covered > LEAST_COVERAGE,
            "Take more photos from the side that is missing in the coverage map.",
        ),
    ]


@dataclass(frozen=True)
class Verdict:
    """The first thing that is read."""

    level: Level
    title: str
    sentences: tuple[str, ...]
    actions: tuple[str, ...]


def verdict(report: Report) -> Verdict:
    """Whether the result holds what can be expected of it, and what to do where it does not."""
    failed = [check for check in checks(report) if not check.good]
    grave = [w for w in report.warnings if w.code in GRAVE]
    sentences = [placement_sentence(report), photos_sentence(report), *(w.message for w in grave)]
    level: Level = "attention"
    if grave:
        title = "Look before use: all places are in doubt."
    elif failed:
        title = f"Look before use: {len(failed)} of {len(checks(report))} checks failed."
    elif report.warnings:
        title, level = "The result holds what can be expected, with the warnings below.", "note"
    else:
        title, level = "The result holds what can be expected.", "good"
    actions = [*(WARNING_ADVICE[w.code] for w in grave), *(check.action for check in failed)]
    return Verdict(level, title, tuple(sentences), tuple(actions))


def placement_sentence(report: Report) -> str:
    """How sure the places are."""
    middle, most = report.sigma_mm.median, report.sigma_mm.p95
    if not (math.isfinite(middle) and math.isfinite(most)):
        return "How exactly the spectra are placed is not known: the run states no standard deviation."
    return (
        f"The spectra of the specimen are placed to about {_rounded(middle)} mm: the stated standard deviation of a "
        f"point's position is {middle:.3f} mm (median) and below {most:.3f} mm for 95 % of the points."
    )


def photos_sentence(report: Report) -> str:
    """How many photos were used, and why not all."""
    given, count = report.photos.given, len(report.photos.used)
    if not given - count:
        return f"All {given} photos were used."
    reasons: dict[str, int] = {}
    for refused in report.photos.refused:
        reasons[refused.code] = reasons.get(refused.code, 0) + 1
    why = ", ".join(f"{n} {code.removeprefix('photo_').replace('_', ' ')}" for code, n in sorted(reasons.items()))
    verb = "was" if given - count == 1 else "were"
    return f"{given - count} of {given} photos {verb} not used{f' ({why})' if why else ''}."


def mm(value: float, digits: int = 3) -> str:
    """A length in mm as text; a dash where it is not known."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "–"


def _rounded(value: float) -> str:
    """To one significant digit, as one would say it."""
    if value <= 0:
        return "0"
    digits = max(0, -math.floor(math.log10(value)))
    return f"{value:.{digits}f}"
