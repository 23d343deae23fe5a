"""Accuracy against truth: where each spectrum of the specimen lies, and where it truly was measured."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from bench.enlarge import enlarge
from bench.measure import Measured, measure
from bench.real import APPLE, bench_apple
from bench.sample import SAMPLE
from specimap_core.truth.judge import TruthComparison, judge
from specimap_validation.phantom import PhantomSettings, write_phantom
from specimap_validation.photo_subsets import even_subset


@dataclass(frozen=True)
class Case:
    """An acquisition with truth: ``folder``, the ``share`` of its photos that is used, evenly dropped, and the ``size``
    that they are enlarged to, where they are; ``made_of``: what is written into ``folder`` first."""

    name: str
    folder: Path
    share: float = 1.0
    size: tuple[int, int] | None = None
    made_of: PhantomSettings | None = None


SHARP = PhantomSettings(seed=71, photo_size=1280, bands=8, wavelength_nm=(400.0, 1000.0))


def cases(data: Path | None, work: Path) -> list[Case]:
    """The sample, as it is and as a phone's photos; an own phantom; and the others where the test data are at hand."""
    found = [
        Case("sample", SAMPLE),
        Case("sample, enlarged to 3000 x 3000", SAMPLE, size=(3000, 3000)),
        Case("sample, enlarged to 4000 x 3000", SAMPLE, size=(4000, 3000)),
        Case("own phantom, sharp at 1280 x 1280", work / "sharp", made_of=SHARP),
    ]
    if data is not None:
        phantom = data / "phantom_a"
        found += [
            Case("phantom A", phantom),
            Case("phantom A, 80 % of the photos", phantom, 0.8),
            Case("phantom A, 50 % of the photos", phantom, 0.5),
            Case("phantom hard", data / "phantom_hard"),
            *(
                Case(f"path-traced {file.parent.name}", file.parent)
                for file in sorted((data / "path_traced").glob("*/truth.npz"))
            ),
        ]
    return found


def bench_accuracy(console: Console, work: Path, repeats: int) -> dict[str, object]:
    """One run a case, by the camera and by the published homography; ``repeats`` does not apply: runs are seeded."""
    del repeats
    value = os.environ.get("SPECIMAP_TEST_DATA")
    data = Path(value) if value else None
    table = Table(title="Position of the specimen's spectra against truth", title_justify="left")
    for heading in (
        "acquisition",
        "photos used",
        "median mm",
        "p95 mm",
        "coverage",
        "scale",
        "2D corner mm",
        "3D corner mm",
        "homography median / p95 mm",
        "seconds",
    ):
        first = heading == "acquisition"
        table.add_column(heading, justify="left" if first else "right", no_wrap=first)
    figures: dict[str, object] = {}
    for number, case in enumerate(cases(data, work)):
        if case.made_of:
            write_phantom(case.made_of, case.folder)
        photos, out = work / f"case_{number}", work / f"case_{number}_out"
        photos.mkdir(exist_ok=True)
        used = even_subset(sorted((case.folder / "rgb").iterdir()), case.share)
        if case.size:
            enlarge(used, photos, case.size)
        for photo in () if case.size else used:
            shutil.copyfile(photo, photos / photo.name)
        run = _measured(photos, case, out, "camera")
        camera = judge(out, case.folder)
        _measured(photos, case, out, "homography")
        flat = judge(out, case.folder)
        output = run.result
        table.add_row(
            case.name,
            f"{output['photos'][0]} of {output['photos'][1]}",
            f"{camera.median:.3f}",
            f"{camera.p95:.3f}",
            f"{100 * camera.coverage:.1f} %",
            f"{100 * camera.scale:+.2f} %",
            f"{output['corner_2d_mm']:.3f}",
            f"{output['corner_3d_mm']:.3f}",
            f"{flat.median:.3f} / {flat.p95:.3f}",
            f"{run.whole.wall_s:.1f}",
        )
        figures[case.name] = {
            "camera": _figures(camera),
            "homography": _figures(flat),
            "seconds": run.whole.wall_s,
            "report": output,
        }
    console.print(table)
    if data is None:
        console.print("SPECIMAP_TEST_DATA is not set: only the sample was judged.")
    elif (data / APPLE).is_dir():
        figures["apple"] = bench_apple(console, data / APPLE)
    return figures


def _measured(photos: Path, case: Case, out: Path, method: str) -> Measured:
    header = case.folder / "hsi" / "hsi.hdr"
    return measure(["--photos", str(photos), "--cube", str(header), "--out", str(out), "--method", method])


def _figures(found: TruthComparison) -> dict[str, float]:
    return {
        "median_mm": found.median,
        "p95_mm": found.p95,
        "coverage": found.coverage,
        "scale": found.scale,
        "corner_mm": found.corner_mm,
    }
