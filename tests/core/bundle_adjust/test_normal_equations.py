"""Normal equations: put together and solved block by block as they would be as a whole."""

from __future__ import annotations

import numpy as np
import pytest

from specimap_core.arrays import Floats
from specimap_core.bundle_adjust.normal_equations import Assembly, damped_step

LENS, PHOTOS, MARKERS = 5, 7, 4


def equations(*, lens_known: bool = False) -> tuple[Floats, Floats, Floats, Floats]:
    """H and g of every photo's view of every marker, put together; and its derivatives and residuals as a whole."""
    rng = np.random.default_rng(0)
    photo, marker = (x.ravel() for x in np.indices((PHOTOS, MARKERS)))
    start = LENS + 6 * PHOTOS
    columns = np.concatenate(
        [
            np.tile(np.arange(LENS), (len(photo), 1)),
            LENS + 6 * photo[:, None] + np.arange(6),
            start + 6 * marker[:, None] + np.arange(6),
        ],
        axis=1,
    )
    J, r = rng.standard_normal((len(photo), 8, columns.shape[1])), rng.standard_normal((len(photo), 8))
    if lens_known:
        J[..., :LENS] = 0
    whole = np.zeros((len(photo), 8, start + 6 * MARKERS))
    for k, at in enumerate(columns):
        whole[k][:, at] = J[k]
    H, g = Assembly(columns, whole.shape[2])(J, r)
    return H, g, whole.reshape(-1, whole.shape[2]), r.ravel()


def test_blocks_add_up_to_the_whole() -> None:
    H, g, J, r = equations()
    assert np.allclose(H, J.T @ J)
    assert np.allclose(g, J.T @ r)


@pytest.mark.parametrize("damping", [1e-9, 1e-4, 10.0])
def test_the_step_is_that_of_the_whole(damping: float) -> None:
    H, g, _, _ = equations()
    step = damped_step(H, g, damping, (LENS, PHOTOS, 6))
    damped = H + damping * np.diag(np.diag(H))
    assert np.allclose(damped @ step, -g, atol=1e-9)
    assert np.allclose(step, np.linalg.solve(damped, -g), rtol=1e-7)


def test_without_damping_it_is_the_least_squares() -> None:
    H, g, J, r = equations()
    step = damped_step(H, g, 0.0, (LENS, PHOTOS, 6))
    assert np.allclose(step, np.linalg.lstsq(J, -r, rcond=None)[0], rtol=1e-7)


def test_what_nothing_tells_stays_where_it_is() -> None:
    H, g, _, _ = equations(lens_known=True)
    step = damped_step(H, g, 1e-4, (LENS, PHOTOS, 6))
    assert np.allclose(step[:LENS], 0)
    assert (np.abs(step[LENS:]) > 1e-6).all()
