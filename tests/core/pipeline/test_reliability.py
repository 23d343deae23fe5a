"""Whether the stated ``sigma_mm`` holds: shares of true errors within one and two of it, on what it was not set by.

For errors that are normal with the stated standard deviation the shares are 68 and 95 per cent. One specimen's shares
vary by some per cent, since neighbouring points err together and a specimen has few independent places; the average
of several is held tighter.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from specimap_core.truth.judge import judge_with_sigma
from specimap_validation.phantom import PhantomSettings
from tests.support.scenes import shared_phantom, shared_run
from tests.support.shared_folders import SharedFolders

pytestmark = pytest.mark.slow

MEDIUM: dict[str, Any] = {
    "photos": 18,
    "photo_size": 448,
    "cube_rows": 256,
    "cube_cols": 320,
    "bands": 16,
    "mesh_divisions": 96,
}
PHANTOMS = {
    "sharp": PhantomSettings(seed=61, **MEDIUM),
    "blurred": PhantomSettings(
        seed=62, blur_px=0.7, gloss=0.3, exposure_spread=0.2, card_tilt_deg=1.0, card_lift_mm=0.3, **MEDIUM
    ),
}
ONE, TWO = 0.68, 0.95
Shares = tuple[float, float]


def shares_of(shared_folders: SharedFolders, folder: Path) -> Shares:
    """Shares of a run's errors, on an acquisition with truth, within one and two stated standard deviations."""
    judged = judge_with_sigma(shared_run(shared_folders, folder).out, folder)
    assert len(judged.sigma_mm) > 1000
    assert (judged.sigma_mm > 0).all()
    # A constant would tell nothing of one point against another.
    assert np.percentile(judged.sigma_mm, 95) > 1.5 * np.percentile(judged.sigma_mm, 5)
    return judged.within(1), judged.within(2)


@pytest.fixture(scope="module")
def own(shared_folders: SharedFolders) -> dict[str, Shares]:
    """Shares on the own phantoms."""
    return {
        name: shares_of(shared_folders, shared_phantom(shared_folders, settings).folder)
        for name, settings in PHANTOMS.items()
    }


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(
            "sharp",
            marks=pytest.mark.xfail(
                strict=True,
                raises=AssertionError,
                reason="sigma is too large for sharp photos: 79 % within one, since the registration, good to 0.01 mm,"
                " is stated with 0.03 mm, whatever the photos' blur",
            ),
        ),
        "blurred",
    ],
)
def test_stated_deviations_hold_on_a_specimen_that_did_not_set_them(own: dict[str, Shares], name: str) -> None:
    assert_near(own[name], 0.10, 0.06)


@pytest.mark.parametrize("name", PHANTOMS)
def test_stated_deviations_are_not_too_small_on_a_specimen_that_did_not_set_them(
    own: dict[str, Shares], name: str
) -> None:
    one, two = own[name]
    assert one >= ONE - 0.10, own
    assert two >= TWO - 0.06, own


def test_stated_deviations_hold_on_average(own: dict[str, Shares]) -> None:
    one, two = np.mean(list(own.values()), axis=0)
    assert_near((one, two), 0.06, 0.04)


def test_stated_deviations_hold_on_path_traced_tissue(data_dir: Path, shared_folders: SharedFolders) -> None:
    assert_near(shares_of(shared_folders, data_dir / "phantom_hard"), 0.06, 0.04)


def test_stated_deviations_hold_where_they_were_set(data_dir: Path, shared_folders: SharedFolders) -> None:
    assert_near(shares_of(shared_folders, data_dir / "phantom_a"), 0.06, 0.04)


def assert_near(shares: Shares, allowed_one: float, allowed_two: float) -> None:
    """Within what is allowed of a normal distribution's shares."""
    one, two = shares
    assert abs(one - ONE) <= allowed_one, shares
    assert abs(two - TWO) <= allowed_two, shares
