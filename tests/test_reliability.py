"""Whether the stated ``sigma_mm`` holds: shares of true errors within one and two of it, on what it was not set by.

For errors that are normal with the stated standard deviation the shares are 68 and 95 per cent. One specimen's shares
vary by some per cent, since neighbouring points err together and a specimen has few independent places; the average
of several is held tighter.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from specimap.core.evidence.truth import judge_with_sigma
from specimap.core.phantom import PhantomSettings, write_phantom
from specimap.core.pipeline import Inputs, PipelineSettings, run_pipeline

MEDIUM = {"photos": 18, "photo_size": 448, "cube_rows": 256, "cube_cols": 320, "bands": 16, "mesh_divisions": 96}
PHANTOMS = {
    "sharp": PhantomSettings(seed=41, **MEDIUM),  # type: ignore[arg-type]
    "blurred": PhantomSettings(
        seed=42, blur_px=0.7, gloss=0.3, exposure_spread=0.2, card_tilt_deg=1.0, card_lift_mm=0.3, **MEDIUM  # type: ignore[arg-type]
    ),
}
ONE, TWO = 0.68, 0.95
Shares = tuple[float, float]


def shares_of(folder: Path, out: Path) -> Shares:
    """Run on an acquisition with truth; shares of the errors within one and two stated standard deviations."""
    run_pipeline(Inputs(folder / "rgb", folder / "hsi" / "hsi.hdr"), out, PipelineSettings())
    judged = judge_with_sigma(out, folder)
    assert len(judged.sigma_mm) > 1000
    assert (judged.sigma_mm > 0).all()
    # A constant would tell nothing of one point against another.
    assert np.percentile(judged.sigma_mm, 95) > 1.5 * np.percentile(judged.sigma_mm, 5)
    return judged.within(1), judged.within(2)


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Shares]:
    """Shares on the own phantoms."""
    found = {}
    for name, settings in PHANTOMS.items():
        folder = tmp_path_factory.mktemp(name)
        write_phantom(settings, folder / "in")
        found[name] = shares_of(folder / "in", folder / "out")
    return found


@pytest.mark.parametrize("name", PHANTOMS)
def test_stated_deviations_hold_on_a_specimen_that_did_not_set_them(own: dict[str, Shares], name: str) -> None:
    one, two = own[name]
    assert abs(one - ONE) <= 0.10, own
    assert abs(two - TWO) <= 0.06, own


def test_stated_deviations_hold_on_average(own: dict[str, Shares]) -> None:
    one, two = np.mean(list(own.values()), axis=0)
    assert abs(one - ONE) <= 0.06, own
    assert abs(two - TWO) <= 0.04, own


@pytest.mark.parametrize("name", ["phantom_a", "phantom_hard"])
def test_stated_deviations_hold_on_path_traced_tissue(data_dir: Path, tmp_path: Path, name: str) -> None:
    one, two = shares_of(data_dir / name, tmp_path / "out")
    assert abs(one - ONE) <= 0.06, (one, two)
    assert abs(two - TWO) <= 0.04, (one, two)
