"""Print a report as tables."""

from __future__ import annotations

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from specimap_core.register.figures import LeaveOneOut
from specimap_core.report.model import Report

PUBLISHED = {"2d": "0.013-0.017", "3d": "0.945-0.974"}


def _left_out(figures: LeaveOneOut | None) -> str:
    return "-" if figures is None else f"{figures.median:.3f} (max {figures.maximum:.3f})"


def print_report(report: Report) -> None:
    """Print a report on standard output."""
    console = Console()
    table = Table(title="Accuracy at the markers, mm", title_justify="left")
    for heading in ("", *report.methods, "published"):
        table.add_column(heading)
    methods = report.methods.values()
    table.add_row(
        "2D corner error, mean ± sd",
        *(f"{m.corner_2d_mm.mean:.3f} ± {m.corner_2d_mm.std:.3f}" for m in methods),
        PUBLISHED["2d"],
    )
    table.add_row("3D corner error, median", *(f"{m.corner_3d_mm.median:.3f}" for m in methods), PUBLISHED["3d"])
    table.add_row("leave one marker out, median", *(_left_out(m.leave_one_marker_out_mm) for m in methods), "-")
    console.print(table)
    rows = Table(show_header=False)
    edge, photos = report.edge_length_mm, report.photos
    rows.add_row("method, backend, adjustment", f"{report.method}, {report.backend}, {report.adjustment}")
    rows.add_row("photos used", f"{len(photos.used)} of {photos.given}")
    for refused in photos.refused:
        rows.add_row(f"  refused {escape(refused.name)}", escape(f"{refused.code}: {refused.reason}"))
    rows.add_row("markers in photos, in cube", escape(f"{report.marker_ids}, {report.marker_ids_in_cube}"))
    rows.add_row("marker edge, mm", f"{edge.mean:.4f} ± {edge.std:.4f} (known: {edge.expected})")
    rows.add_row(
        "corners in photos, RMS px", f"{report.reprojection_px.before:.3f} -> {report.reprojection_px.after:.3f}"
    )
    rows.add_row("corners in cube, RMS px", f"{report.cube_camera.reprojection_rms_px:.3f}")
    rows.add_row("stated sigma of specimen, mm", f"{report.sigma_mm.median:.3f} (95 %: {report.sigma_mm.p95:.3f})")
    rows.add_row(
        "parallax that homography leaves, mm",
        f"{report.parallax_removed_mm.median:.2f} (max {report.parallax_removed_mm.maximum:.2f})",
    )
    rows.add_row("points", f"{report.coverage.points:,}, of which specimen {report.coverage.specimen_points:,}")
    rows.add_row("coverage between markers", f"{100 * report.coverage.between_markers:.1f} %")
    rows.add_row("seconds", ", ".join(f"{k} {v:.1f}" for k, v in report.seconds.items()))
    if report.reused_stages:
        rows.add_row("taken from an earlier run", ", ".join(report.reused_stages))
    for warning in report.warnings:
        rows.add_row(f"[yellow]{warning.code}[/]", escape(warning.message))
    console.print(rows)
