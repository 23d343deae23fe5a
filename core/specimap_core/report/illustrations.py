"""The sections that show: photos, corners, coverage, surface, and errors against truth."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from specimap_core.report import photo_figures, result_figures
from specimap_core.report.blocks import Block, Paragraph, Picture, Table
from specimap_core.report.inputs import Material
from specimap_core.report.model import PhotoCorners
from specimap_core.report.wording import mm

MOST_IDS = 8
OLD = "The run's version did not keep {what}; a repeated run does."


def photo_blocks(material: Material) -> Iterator[Block]:
    """The used photos with the corners drawn on them, and as a table."""
    report, photos = material.report, material.report.photo_corners
    if not photos:
        yield Paragraph(f"{len(report.photos.used)} photos were used: {', '.join(report.photos.used)}.")
        yield Paragraph(OLD.format(what="the corners in the photos"))
        return
    lengths = np.concatenate([photo_figures.lengths_of(photo) for photo in photos])
    factor = photo_figures.exaggeration(lengths, photos[0].width_px)
    together = photo_figures.photos_a_sheet(photos[0])
    for start in range(0, len(photos), together):
        part = photos[start : start + together]
        tiles = material.tiles[start : start + together]
        yield Picture(
            partial(photo_figures.draw_photos, part, tiles, start + 1, factor),
            "photo",
            f"Photos {start + 1} to {start + len(part)}, each with the outlines of the markers found in it.",
            f"Used photos {start + 1} to {start + len(part)}: detected markers in blue; in orange what the joint "
            f"adjustment leaves between a corner as measured and as computed, exaggerated {factor:g} times. Numbers "
            "as in the table." + ("" if tiles else " The photos themselves were not kept."),
        )
    rows = tuple(
        (str(k), photo.name, f"{photo.width_px} x {photo.height_px}", _ids(photo), _rms(photo))
        for k, photo in enumerate(photos, start=1)
    )
    yield Table(
        "Used photos; sizes as worked with",
        ("No.", "Photo", "Size, px", "Markers", "RMS, px"),
        rows,
        (0.08, 0.34, 0.16, 0.3, 0.12),
        numeric=(0, 4),
    )


def corner_blocks(material: Material) -> Iterator[Block]:
    """Residuals in photos and cube, and each marker left out."""
    report = material.report
    before, after = report.reprojection_px.before, report.reprojection_px.after
    yield Paragraph(
        f"Corners in the photos fit to {after:.3f} px (RMS) after the joint adjustment, {before:.3f} px before it. "
        "Arrows that point the same way all over a picture would mean a lens that is not modelled, or a marker that "
        "moved."
    )
    if report.photo_corners:
        lengths = np.concatenate([photo_figures.lengths_of(photo) for photo in report.photo_corners])
        factor = photo_figures.exaggeration(lengths, report.photo_corners[0].width_px)
        yield Picture(
            partial(photo_figures.draw_residuals, report.photo_corners, factor),
            "map",
            f"Residuals of {lengths.size} corners in the image plane, the distribution of their lengths, and their "
            f"root mean square for each of {len(report.photo_corners)} photos.",
            f"Residuals of all corners in all photos; arrows exaggerated {factor:g} times.",
        )
    if report.cube_corners is not None and report.cube_corners.marker_ids:
        cube = report.cube_corners
        stretch = photo_figures.exaggeration(photo_figures.lengths_of(cube), cube.cols)
        yield Picture(
            partial(photo_figures.draw_cube_corners, cube, stretch),
            "chart",
            f"The {len(cube.marker_ids)} markers found in the cube with the residuals of their corners.",
            f"Markers in the cube, numbered by id, and the residuals of the cube's solved camera, exaggerated "
            f"{stretch:g} times; {report.cube_camera.reprojection_rms_px:.3f} px RMS.",
        )
    left = [m.leave_one_marker_out_mm for m in report.methods.values()]
    if any(figures is not None for figures in left):
        yield Picture(
            partial(photo_figures.draw_left_out, report.methods),
            "chart",
            "Bars of the mean error at each marker that was left out of the registration, for each method.",
            "The registration fitted without each marker in turn and measured on it. One marker much worse than the "
            "others was moved, is curled, or is covered in part.",
        )
    else:
        yield Paragraph("No marker could be left out: three or more are needed in the cube.")


def coverage_blocks(material: Material) -> Iterator[Block]:
    """Which pixels have points, and which of these are doubtful."""
    report, cloud = material.report, material.cloud
    coverage = report.coverage
    yield Paragraph(
        f"{100 * coverage.between_markers:.1f} % of the cube's pixels between the markers have a point: "
        f"{coverage.points:,} points, {coverage.specimen_points:,} of them on the specimen."
    )
    yield Picture(
        lambda: result_figures.draw_coverage(cloud, material.frame, report.cube_corners),
        "map",
        "Map of the cube: specimen, marker cards, surroundings, and pixels without a point.",
        "The cube as it was recorded. Pixels without a point have no reconstructed surface under them. The scale bar "
        "holds at the height of the markers.",
    )
    yield Picture(
        lambda: result_figures.draw_flags(cloud, material.frame),
        "map",
        "Map of the cube with the points that are flagged as grazing, interpolated, saturated, empty or occluded.",
        "Flagged points, the gravest reason of each pixel, in the cube as it was recorded; shares of the specimen's "
        "points. Leave flagged points out where places or spectra must be certain.",
    )


def surface_blocks(material: Material) -> Iterator[Block]:
    """The result from above, its height and its uncertainty."""
    cloud = material.cloud
    yield Picture(
        lambda: result_figures.draw_above(material.above, material.preview),
        "map",
        "The specimen from above in the colours of the photos"
        + (", and in false colours made of its spectra." if material.preview is not None else "."),
        "Straight from above, in the marker frame: x to the right, y up.",
    )
    yield Picture(
        lambda: result_figures.draw_height(material.above),
        "map",
        "Map of the height over the marker plane in mm.",
        "Height of the topmost surface in the marker frame; lines every 2 mm.",
    )
    yield Picture(
        lambda: result_figures.draw_sigma(cloud, material.frame),
        "map",
        "Map of the stated standard deviation of each point's position in mm.",
        "What the run states of its own uncertainty, in the cube as it was recorded: the lighter, the less certain.",
    )
    yield Picture(
        lambda: result_figures.draw_sigma_histogram(cloud),
        "chart",
        "Histogram of the stated standard deviations of the specimen's points.",
        f"Stated standard deviation of the specimen's points, median {mm(material.report.sigma_mm.median)} mm. The "
        "highest 0.5 % are not shown.",
    )


def truth_blocks(material: Material) -> Iterator[Block]:
    """Errors against a phantom's truth."""
    errors = material.errors
    if errors is None:
        return
    found = errors.errors
    yield Paragraph(
        "This acquisition is of a phantom whose shape is known exactly. The error is the distance of each point of the "
        "specimen from where its pixel truly looked, after a rotation and a shift that bring the corners onto the true "
        "ones; size is not adjusted. It contains everything: corners, poses, depth, registration."
    )
    yield Table(
        "Errors against truth",
        ("Figure", "Value"),
        (
            ("Median error", f"{mm(found.median)} mm"),
            ("95 % of the errors are below", f"{mm(found.p95)} mm"),
            ("Pixels of the specimen that have a point", f"{100 * found.coverage:.2f} %"),
            ("Size of the result over the true one", f"{100 * found.scale:+.2f} %"),
            ("Marker corners, median", f"{mm(found.corner_mm)} mm"),
            ("Errors within one stated sigma", f"{100 * errors.within(1):.1f} %"),
            ("Errors within two stated sigmas", f"{100 * errors.within(2):.1f} %"),
        ),
        (0.6, 0.4),
        numeric=(1,),
    )
    yield Picture(
        lambda: result_figures.draw_error_map(errors, material.frame),
        "map",
        "Map of the error of each point of the specimen in mm.",
        "Errors in the cube as it was recorded. Steep flanks carry the largest ones.",
    )
    yield Picture(
        lambda: result_figures.draw_reliability(errors),
        "chart",
        "Cumulative distribution of the errors, and the share of errors within k stated standard deviations.",
        "Left: share of the points whose error is below. Right: a curve above the dots means that the stated standard "
        "deviations are larger than the errors warrant, one below them that they promise too much.",
    )


def _ids(photo: PhotoCorners) -> str:
    ids = photo.marker_ids
    return ", ".join(map(str, ids)) or "none" if len(ids) <= MOST_IDS else f"{len(ids)} markers"


def _rms(photo: PhotoCorners) -> str:
    lengths = photo_figures.lengths_of(photo)
    return f"{np.sqrt((lengths**2).mean()):.3f}" if lengths.size else "–"
