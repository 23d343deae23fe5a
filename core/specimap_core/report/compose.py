"""The accuracy report of a run as sections of text, tables and figures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime

from specimap_core.register.figures import LeaveOneOut, MethodFigures
from specimap_core.report import published
from specimap_core.report.blocks import Block, Bullets, Callout, Document, Level, Paragraph, Section, Table
from specimap_core.report.certificate_blocks import certificate_blocks
from specimap_core.report.illustrations import (
    corner_blocks,
    coverage_blocks,
    photo_blocks,
    surface_blocks,
    truth_blocks,
)
from specimap_core.report.inputs import Material
from specimap_core.report.model import Report
from specimap_core.report.wording import (
    MEANINGS,
    REFUSAL_ADVICE,
    UNKNOWN_REFUSAL_ADVICE,
    UNKNOWN_WARNING_ADVICE,
    WARNING_ADVICE,
    checks,
    mm,
    verdict,
)
from specimap_core.truth.judge import Judged

STAGE_NAMES = {
    "reconstruct": "1 reconstruct",
    "adjust": "2 bundle-adjust",
    "render": "3 render",
    "register": "4 register",
}
_HASH = 24
_VALUE = 120
_KINDS = {
    "frame": "a frame camera",
    "scan_rows": "a push-broom, row by row",
    "scan_columns": "a push-broom, column by column",
}


def compose(material: Material) -> Document:
    """The whole document; figures are drawn when they are asked for."""
    report = material.report
    sections = [
        Section("verdict", "Verdict", tuple(_verdict(report, material.errors))),
        Section("figures", "Accuracy at the markers", tuple(_figures(report))),
    ]
    if report.certificate is not None:
        checked = tuple(certificate_blocks(report.certificate))
        sections.append(Section("certificate", "Checked against unused evidence", checked))
    if material.errors is not None:
        sections.append(Section("truth", "Accuracy against truth", tuple(truth_blocks(material))))
    sections += [
        Section("photos", "Photos", (*_refused(report), *photo_blocks(material))),
        Section("corners", "Marker corners", tuple(corner_blocks(material))),
        Section("coverage", "Where there are spectra", tuple(coverage_blocks(material))),
        Section("surface", "Surface and uncertainty", tuple(surface_blocks(material))),
        Section("run", "How it was made", tuple(_run(report))),
    ]
    return Document(
        title="Accuracy report",
        subtitle=f"Run of {_date(report.created)}, method {report.method}",
        created=report.created,
        footer=f"Specimap {report.specimap_version}. For research use only. Not a medical device; not validated for "
        "clinical decisions.",
        sections=tuple(sections),
    )


def _verdict(report: Report, errors: Judged | None) -> Iterator[Block]:
    judged = verdict(report)
    if errors is not None:
        found = errors.errors
        truth = f"Against truth the median error is {mm(found.median)} mm, and 95 % are below {mm(found.p95)} mm."
        judged = replace(judged, sentences=(*judged.sentences, truth))
    yield Callout(judged.level, judged.title, " ".join(judged.sentences), " ".join(judged.actions))
    rows = tuple((c.name, c.found, c.wanted, "good" if c.good else c.action) for c in checks(report))
    marks: tuple[Level, ...] = tuple("good" if c.good else "attention" for c in checks(report))
    head = ("Check", "Found", "Wanted", "Result, what to do")
    yield Table("Checks", head, rows, (0.23, 0.23, 0.2, 0.34), marks=marks)
    for warning in report.warnings:
        todo = WARNING_ADVICE.get(warning.code, UNKNOWN_WARNING_ADVICE)
        yield Callout("note", f"Warning: {warning.code.replace('_', ' ')}", warning.message, todo)
    if not report.warnings:
        yield Paragraph("The run gave no warnings.")


def _figures(report: Report) -> Iterator[Block]:
    yield Paragraph(
        "All lengths in mm. These figures need no truth: they are measured at the printed markers. The published ones "
        f"are those of {published.REFERENCE}, on two specimens."
    )
    names = sorted(report.methods, key=lambda name: name != report.method)
    methods = [report.methods[name] for name in names]
    edge, parallax, sigma = report.edge_length_mm, report.parallax_removed_mm, report.sigma_mm
    rest = len(names) * ("",) + ("–",)
    rows = (
        ("2D corner error, mean ± sd", *map(_corner_2d, methods), published.CORNER_2D_WORDS),
        ("3D corner error, median (quartiles)", *map(_corner_3d, methods), published.CORNER_3D_WORDS),
        ("Leaving a marker out, median (largest)", *(_leave_one_out(m.leave_one_marker_out_mm) for m in methods), "–"),
        (f"Marker edge, mean ± sd (known: {edge.expected:g})", f"{mm(edge.mean)} ± {mm(edge.std)}", *rest[1:]),
        ("Between the two methods, median (largest)", f"{mm(parallax.median)} ({mm(parallax.maximum)})", *rest[1:]),
        ("Stated sigma of the specimen, median (95 %)", f"{mm(sigma.median)} ({mm(sigma.p95)})", *rest[1:]),
    )
    yield Table(
        "Figures of this run beside the published ones",
        ("Figure", *(f"This run, {name}" for name in names), "Published"),
        rows,
        (0.36, *(0.47 / max(len(names), 1) for _ in names), 0.17),
        numeric=tuple(range(1, len(names) + 2)),
    )
    yield Table(
        "What they can and cannot say", ("Figure", "What it says", "What it cannot say"), MEANINGS, (0.24, 0.4, 0.36)
    )


def _corner_2d(figures: MethodFigures) -> str:
    return f"{mm(figures.corner_2d_mm.mean)} ± {mm(figures.corner_2d_mm.std)}"


def _corner_3d(figures: MethodFigures) -> str:
    found = figures.corner_3d_mm
    return f"{mm(found.median)} ({mm(found.q1)}, {mm(found.q3)})"


def _leave_one_out(figures: LeaveOneOut | None) -> str:
    return "–" if figures is None else f"{mm(figures.median)} ({mm(figures.maximum)})"


def _refused(report: Report) -> Iterator[Block]:
    if report.photos.refused:
        yield Table(
            "Photos that were not used",
            ("Photo", "Reason", "What to do"),
            tuple(
                (r.name, r.reason, REFUSAL_ADVICE.get(r.code, UNKNOWN_REFUSAL_ADVICE)) for r in report.photos.refused
            ),
            (0.25, 0.4, 0.35),
        )


def _run(report: Report) -> Iterator[Block]:
    rows = []
    for stage, seconds in report.seconds.items():
        kept = "taken from an earlier run" if stage in report.reused_stages else ""
        rows.append((STAGE_NAMES.get(stage, stage), f"{seconds:.1f}", _published_seconds(stage), kept))
    yield Table(
        "Seconds per stage; the published ones on one A100 GPU",
        ("Stage", "Seconds", "Published", ""),
        tuple(rows),
        (0.35, 0.15, 0.2, 0.3),
        numeric=(1, 2),
    )
    camera = report.cube_camera
    yield Bullets(
        (
            ("Program", f"Specimap {report.specimap_version}"),
            ("Method, backend, adjustment", f"{report.method}, {report.backend}, {report.adjustment}"),
            ("Markers in the photos", ", ".join(map(str, report.marker_ids))),
            (
                "Markers in the cube",
                f"{', '.join(map(str, report.marker_ids_in_cube))}; found in the {camera.markers_found_in}",
            ),
            ("Photos' focal length", f"{report.photo_focal_px:.1f} px"),
            (
                "Cube's camera",
                f"{camera.distance_mm:.0f} mm above the markers, focal length {camera.focal_px:.0f} px "
                f"± {100 * camera.focal_relative_sd:.0f} %, corners {camera.reprojection_rms_px:.3f} px RMS, roll "
                f"{camera.roll_deg:.1f} degrees{', mirrored' if camera.mirrored else ''}; {_KINDS[camera.model]}, "
                f"pixels {camera.pixel_aspect:.3f} times as high as wide",
            ),
            (
                "RANSAC of the homography",
                f"{report.inliers.n} of {report.inliers.of} corners within "
                f"{report.inliers.threshold_px:g} px of the coarse grid, {report.inliers.threshold_mm:g} mm",
            ),
            ("Points", f"{report.coverage.points:,}, of which on the specimen {report.coverage.specimen_points:,}"),
        )
    )
    flat = tuple((name, _short(value)) for name, value in flattened(report.settings))
    if flat:
        yield Table("Settings", ("Setting", "Value"), flat, (0.5, 0.5))
    if report.inputs:
        hashes = tuple((name, value) for name, value in report.inputs.items())
        yield Table("Hashes of the inputs (SHA-256) and key of the result", ("Input", "Hash"), hashes, (0.2, 0.8))
    for warning in report.warnings:
        if warning.code.startswith("licence"):
            yield Callout("attention", "Licence", warning.message, WARNING_ADVICE.get(warning.code, ""))


def flattened(settings: dict[str, object], prefix: str = "") -> Iterator[tuple[str, object]]:
    """Nested settings as ``(a.b, value)``."""
    for name, value in settings.items():
        if isinstance(value, dict):
            yield from flattened(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _date(created: str) -> str:
    try:
        return datetime.fromisoformat(created).astimezone(UTC).strftime("%Y-%m-%d %H:%M UTC")
    except ValueError:
        return created


def _published_seconds(stage: str) -> str:
    return published.STAGE_SECONDS_WORDS.get(stage, "–")


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= _VALUE else f"{text[:_VALUE]}…"
