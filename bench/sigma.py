"""Setting the shares of ``sigma_mm`` on some phantoms, and judging what comes of it on others."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from scipy.optimize import minimize

from bench.scene import Scene, scaled_maps
from bench.service.sheet import Sheet
from specimap_core.arrays import Floats
from specimap_core.photos.folder import photo_paths
from specimap_core.pipeline.clock import Clock
from specimap_core.pipeline.outputs import Outputs
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.pipeline.stages import adjust_stage, mesh_of, reconstruct_stage
from specimap_core.surface.raycast import RayCaster
from specimap_core.surface.regions import raised_places
from specimap_core.surface.uncertainty import (
    SHARES,
    Evidence,
    Shares,
    bend_mm,
    point_sigma,
    refined_scatter,
    step_height,
)
from specimap_validation.phantom import PhantomSettings, load_truth, write_phantom

CUBE: dict[str, Any] = {"bands": 8, "wavelength_nm": (400.0, 1000.0)}
SETTING = {
    "no defect (11)": PhantomSettings(seed=11, **CUBE),
    "gloss 0.3 (12)": PhantomSettings(seed=12, gloss=0.3, **CUBE),
    "blur 0.7 px, exposure 0.2 (13)": PhantomSettings(seed=13, blur_px=0.7, exposure_spread=0.2, **CUBE),
    "texture 0.5 (14)": PhantomSettings(seed=14, texture_contrast=0.5, **CUBE),
    "distortion, tilted cards, breathing 0.5 % (15)": PhantomSettings(
        seed=15, k1=-0.08, card_tilt_deg=1.5, card_lift_mm=0.4, focal_spread=0.005, **CUBE
    ),
    "blur 1 px, gloss 0.2 (16)": PhantomSettings(seed=16, blur_px=1.0, gloss=0.2, **CUBE),
}
"""What the shares are set on."""
JUDGING = {
    "no defect (51)": PhantomSettings(seed=51, **CUBE),
    "gloss 0.4, tilted cards (52)": PhantomSettings(seed=52, gloss=0.4, card_tilt_deg=1.0, card_lift_mm=0.3, **CUBE),
    "blur 0.8 px (53)": PhantomSettings(seed=53, blur_px=0.8, **CUBE),
    "texture 0.4, exposure 0.2 (54)": PhantomSettings(seed=54, texture_contrast=0.4, exposure_spread=0.2, **CUBE),
    "breathing 1 %, distortion (55)": PhantomSettings(seed=55, focal_spread=0.01, k1=-0.1, k2=0.03, **CUBE),
    "blur 1.2 px, gloss 0.3 (56)": PhantomSettings(seed=56, blur_px=1.2, gloss=0.3, **CUBE),
    "1024 px photos (57)": PhantomSettings(seed=57, photo_size=1024, **CUBE),
    "16 photos of 384 px (58)": PhantomSettings(seed=58, photos=16, photo_size=384, **CUBE),
}
"""What they are judged on. A path-traced phantom joins each, where they are at hand."""
TRACED_SETTING, TRACED_JUDGING = {"phantom A": "phantom_a"}, {"phantom hard": "phantom_hard"}

ONE, TWO = 0.68, 0.95
ALLOWED_ONE, ALLOWED_TWO = 0.06, 0.04
ROLES = ("set on it", "judged on it")
GROUPS = 5
"""A specimen's points are judged in so many groups by what is stated of them, by how much the surface bends and by how
much it rises there: the shares are to hold in each, or sigma would not tell one place from another."""


@dataclass(frozen=True, eq=False)
class Specimen:
    """A run whose ``sigma_mm`` can be stated anew: what is known of its mesh, where its points lie on that, and their
    ``errors`` (n,) mm."""

    evidence: Evidence
    caster: RayCaster
    triangle: NDArray[np.int32]
    barycentric: NDArray[np.float32]
    bend_mm: NDArray[np.float32]
    step_mm: NDArray[np.float32]
    corner_mm: float
    registration_mm: float
    errors: Floats

    def sigma(self, shares: Shares) -> NDArray[np.float32]:
        """Standard deviations (n,) mm."""
        surface = self.caster.interpolate(self.evidence.sigma(shares)[:, None], self.triangle, self.barycentric).ravel()
        return point_sigma(surface, self.step_mm, self.corner_mm, self.registration_mm, shares)

    def within(self, shares: Shares) -> tuple[float, float]:
        """Shares of the errors within one and two standard deviations."""
        unit = self.errors / self.sigma(shares)
        return float((unit <= 1).mean()), float((unit <= 2).mean())

    def loss(self, shares: Shares) -> float:
        """How far both shares are from a normal distribution's, over what is allowed, squared: mean over the groups."""
        sigma = self.sigma(shares)
        unit = self.errors / sigma
        groups = [
            group
            for key in (sigma, self.bend_mm, self.step_mm)
            for group in np.array_split(np.argsort(key, kind="stable"), GROUPS)
        ]
        return float(np.mean([_off(float((unit[g] <= 1).mean()), float((unit[g] <= 2).mean())) for g in groups]))


def _off(one: float, two: float) -> float:
    return ((one - ONE) / ALLOWED_ONE) ** 2 + ((two - TWO) / ALLOWED_TWO) ** 2


def bench_sigma(console: Console, work: Path, repeats: int) -> dict[str, object]:
    """Set the shares anew, and judge those in force; runs are seeded, so ``repeats`` does not apply."""
    del repeats
    value = os.environ.get("SPECIMAP_TEST_DATA")
    setting, judging = dict(_own(SETTING, work)), dict(_own(JUDGING, work))
    if value:
        for found, traced in ((setting, TRACED_SETTING), (judging, TRACED_JUDGING)):
            found |= {name: specimen(Path(value) / folder, work / folder) for name, folder in traced.items()}
    best = fitted(list(setting.values()))
    figures: dict[str, Any] = {"fitted": asdict(best), "in_force": asdict(SHARES)}
    for role, found in zip(ROLES, (setting, judging), strict=True):
        lines = {name: [float(np.median(one.errors)), *one.within(SHARES)] for name, one in found.items()}
        lines[f"mean of these {len(found)}"] = np.mean(list(lines.values()), axis=0).tolist()
        figures[role] = lines
    sheet_sigma(figures).show(console)
    return figures


def sheet_sigma(figures: dict[str, Any]) -> Sheet:
    """The table of kept figures."""
    sheet = Sheet(
        "Shares of the true errors within one and two `sigma_mm`",
        ("phantom (seed)", "numbers were", "median mm", "within 1", "within 2"),
    )
    for role in ROLES:
        for name, (median, one, two) in figures[role].items():
            sheet.rows.append([name, role, f"{median:.3f}", f"{100 * one:.1f} %", f"{100 * two:.1f} %"])
    for output, shares in (("Numbers that suit the first best", figures["fitted"]), ("In force", figures["in_force"])):
        sheet.notes.append(f"{output}: {', '.join(f'`{name}` {value:.4g}' for name, value in shares.items())}.")
    return sheet


def fitted(specimens: Sequence[Specimen]) -> Shares:
    """The shares that suit the specimens best, each counting alike."""

    def loss(x: Floats) -> float:
        return float(np.mean([one.loss(Shares(*np.exp(x))) for one in specimens]))

    found = minimize(loss, np.log(astuple(SHARES)), method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-4})
    return Shares(*(float(x) for x in np.exp(found.x)))


def _own(recipes: Mapping[str, PhantomSettings], work: Path) -> Iterator[tuple[str, Specimen]]:
    for name, settings in recipes.items():
        folder = work / f"sigma_{settings.seed}"
        write_phantom(settings, folder)
        yield name, specimen(folder, work / f"sigma_{settings.seed}_out")


def specimen(folder: Path, scratch: Path) -> Specimen:
    """Reconstruct and register a phantom's ``folder``."""
    scratch.mkdir(parents=True, exist_ok=True)
    settings, workers = PipelineSettings(), os.cpu_count() or 1
    store, clock = Outputs(scratch).store, Clock(lambda stage, share: None, lambda: False)
    stage1 = reconstruct_stage(photo_paths(folder / "rgb"), settings, store, "1", clock, workers)
    stage2 = adjust_stage(stage1, settings, store, "2", clock, workers)
    adjusted, maps = stage2.adjusted, scaled_maps(stage1, stage2)
    refined = mesh_of(
        maps, list(stage1.greys), adjusted.lens, adjusted.poses, adjusted.corners, settings, workers=workers
    )
    scene = Scene(folder, load_truth(folder), stage1, stage2, settings)
    placed, at, errors = scene.placed(scene.caster, scene.camera)
    return Specimen(
        Evidence.of(refined, refined_scatter(refined, maps, adjusted.poses, workers=workers)),
        scene.caster,
        placed.triangle[at],
        placed.barycentric[at],
        scene.caster.interpolate(bend_mm(refined.mesh)[:, None], placed.triangle[at], placed.barycentric[at]).ravel(),
        step_height(placed.pixels, placed.xyz[:, 2], scene.refined.camera.pixel_mm)[at],
        scene.adjusted.sigma_layout_mm(raised_places(scene.caster.mesh.vertices, scene.adjusted.corners)),
        scene.refined.lateral_sd_mm,
        errors,
    )
