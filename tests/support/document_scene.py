"""A finished run's folder without a run, for the tests of the document: every value known, every odd one possible."""

from __future__ import annotations

import base64
import json
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path

import numpy as np

from specimap_core.cloud import Cloud, CloudPoints
from specimap_core.cloud.preview import write_preview
from specimap_core.cloud.writer import write_cloud
from specimap_core.photos.contact_sheet import contact_sheet
from specimap_core.register.figures import LeaveOneOut, MethodFigures
from specimap_core.report.model import CubeCorners, PhotoCorners, Report
from tests.support.cloud_scene import FakeCube, counts, scene
from tests.support.result_scene import report_of


def square(x: float, y: float, edge: float = 40.0) -> list[float]:
    """Corners of a marker whose first one is at x, y."""
    return [x, y, x + edge, y, x + edge, y + edge, x, y + edge]


def full_report(points: int, names: tuple[str, ...] = ("a.jpg", "b.jpg", "c.jpg")) -> Report:
    """A report with all its sections; three photos of 320 x 240 with markers 0 and 7 by default."""
    rng = np.random.default_rng(3)
    plain = report_of(points)
    left = LeaveOneOut(median=0.021, maximum=0.043, per_marker={"0": 0.02, "7": 0.03, "2": 0.01})
    own = plain.methods["camera"]
    figures = MethodFigures(corner_2d_mm=own.corner_2d_mm, corner_3d_mm=own.corner_3d_mm, leave_one_marker_out_mm=left)
    photos = [
        PhotoCorners(
            name=name,
            width_px=320,
            height_px=240,
            marker_ids=[0, 7],
            corners_px=[square(30, 30 + k), square(200, 150)],
            residuals_px=rng.normal(0, 0.1, (2, 8)).round(2).tolist(),
        )
        for k, name in enumerate(names)
    ]
    cube = CubeCorners(
        rows=70,
        cols=53,
        marker_ids=[0, 7],
        corners_px=[square(4, 4, 8), square(35, 35, 8)],
        residuals_px=rng.normal(0, 0.05, (2, 8)).round(2).tolist(),
    )
    return plain.model_copy(
        update={
            "photos": plain.photos.model_copy(update={"given": len(names), "used": list(names)}),
            "methods": {"camera": figures, "homography": figures},
            "leave_one_marker_out_mm": left,
            "photo_corners": photos,
            "cube_corners": cube,
            "settings": {"adjust": {"edge_mm": 6.8}, "features": "auto"},
            "inputs": {"cube": "ab" * 32},
        }
    )


def folder_of(
    folder: Path, report: Report | None = None, points: CloudPoints | None = None, *, old: bool = False
) -> Path:
    """A run's folder; ``old``: as a version left it that kept neither corners nor photos."""
    points = scene(70, 53) if points is None else points
    report = full_report(len(points)) if report is None else report
    folder.mkdir(parents=True)
    write_cloud(folder / "cloud.zarr", points, FakeCube(counts()), {"report": report.summary()})
    write_preview(Cloud.open(folder / "cloud.zarr"), folder / "preview.png")
    corners = {"0": [[0, 0, 0], [6.8, 0, 0], [6.8, -6.8, 0], [0, -6.8, 0]]}
    (folder / "corners.json").write_text(json.dumps(corners), encoding="utf-8")
    if old:
        text = report.model_dump_json(indent=1, exclude={"photo_corners", "cube_corners"})
    else:
        text = report.text()
        count = len(report.photo_corners or ())
        images = [np.full((240, 320, 3), (40 * k + 20, 90, 150), np.uint8) for k in range(count)]
        (folder / "photos.jpg").write_bytes(contact_sheet(images))
    (folder / "report.json").write_text(text, encoding="utf-8")
    return folder


# ---- what a page holds --------------------------------------------------------------------------------

VOID = {"meta", "img", "br", "link", "hr", "input"}


@dataclass
class Page(HTMLParser):
    """A page as a reader meets it; parsing fails on tags that do not nest."""

    text: str
    images: list[dict[str, str]] = field(default_factory=list)
    links: list[str] = field(default_factory=list)
    ids: list[str] = field(default_factory=list)
    tags: set[str] = field(default_factory=set)
    headings: list[tuple[str, str]] = field(default_factory=list)
    tables: list[list[list[str]]] = field(default_factory=list)
    said: str = ""
    _open: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.feed(self.text)
        self.close()
        assert self._open == [], f"not closed: {self._open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        named = {name: value or "" for name, value in attrs}
        self.tags.add(tag)
        if tag == "img":
            self.images.append(named)
        if tag == "a":
            self.links.append(named["href"])
        if "id" in named:
            self.ids.append(named["id"])
        assert not any(name.startswith("on") for name in named), f"a handler on {tag}"
        if tag in {"h1", "h2", "h3"}:
            self.headings.append((tag, ""))
        if tag == "table":
            self.tables.append([])
        if tag == "tr":
            self.tables[-1].append([])
        if tag in {"td", "th"}:
            self.tables[-1][-1].append("")
        if tag not in VOID:
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self._open, f"</{tag}> without a start"
        assert self._open[-1] == tag, f"</{tag}> closes <{self._open[-1]}>"
        self._open.pop()

    def handle_data(self, data: str) -> None:
        if "style" in self._open:
            assert "url(" not in data
            assert "@import" not in data
            return
        self.said += data
        if self._open and self._open[-1] in {"h1", "h2", "h3"}:
            tag, before = self.headings[-1]
            self.headings[-1] = tag, before + data
        if self._open and self._open[-1] in {"td", "th"}:
            self.tables[-1][-1][-1] += data

    def pictures(self) -> list[tuple[str, bytes]]:
        """Media type and content of each image; fails where one is not in the page itself."""
        found = []
        for image in self.images:
            head, _, data = image["src"].partition(",")
            assert head.startswith("data:image/"), image["src"][:60]
            assert head.endswith(";base64")
            found.append((head.removeprefix("data:").removesuffix(";base64"), base64.b64decode(data, validate=True)))
        return found

    def row(self, name: str) -> list[str]:
        """The first row that begins with ``name``; a number is the whole of it."""
        rows = [row for table in self.tables for row in table if row]
        return next(row for row in rows if row[0] == name or (row[0].startswith(name) and not name.isdigit()))
