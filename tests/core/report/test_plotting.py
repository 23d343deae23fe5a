"""Figures: the same bytes from any thread, nothing left behind in the library's shared state, scales that hold."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import cv2
import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

from specimap_core.report import plotting


def drawn(_: int = 0) -> Figure:
    figure = plotting.figure(4, 3)
    ax = plotting.styled(figure.add_subplot(), title="Größe", x="x, mm", y="n")
    ax.plot([0, 1, 2], [1, 3, 2], color=plotting.BLUE, label="one")
    plotting.legend(ax)
    plotting.legend_below(figure)
    return figure


@pytest.mark.slow
def test_threads_draw_the_same_and_leave_nothing() -> None:
    before = dict(matplotlib.rcParams)
    with ThreadPoolExecutor(4) as pool:
        texts = set(pool.map(lambda k: plotting.svg(drawn(k)), range(8)))
        pictures = set(pool.map(lambda k: plotting.png(drawn(k), 72), range(8)))
    assert (len(texts), len(pictures)) == (1, 1)
    assert dict(matplotlib.rcParams) == before
    (text,) = texts
    # Letters as outlines, and no date.
    assert "<text" not in text
    assert "dc:date" not in text


def test_sizes_in_pixels() -> None:
    for data in (plotting.png(drawn(), 100), plotting.jpeg(drawn(), 100)):
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        assert image.shape == (300, 400, 3)


def test_nothing_needs_a_screen_or_says_anything() -> None:
    code = (
        "import sys; from specimap_core.report import plotting as p; f = p.figure(); p.styled(f.add_subplot()); "
        "p.png(f); print('matplotlib.pyplot' in sys.modules)"
    )
    described = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
        env={"MPLCONFIGDIR": "/proc/nowhere", "HOME": "/proc/nowhere"},
    )
    assert (described.stdout, described.stderr) == ("False\n", "")


@pytest.mark.parametrize(
    ("px_per_mm", "width_px", "length"),
    [(10, 640, 10), (1, 64, 10), (100, 640, 1), (3, 1000, 50), (float("nan"), 100, 0)],
)
def test_a_scale_bar_is_as_long_as_it_says(px_per_mm: float, width_px: float, length: float) -> None:
    ax = plotting.figure().add_subplot()
    assert plotting.scale_bar(ax, px_per_mm, width_px) == length
    if length:
        start, end = np.asarray(ax.lines[0].get_xdata(), float)
        assert abs((end - start) * width_px - length * px_per_mm) < 1e-9


def test_limits_of_what_there_is() -> None:
    values = np.array([np.nan, 1, 2, 3, np.inf])
    assert plotting.limits(values, (0, 100)) == (1.0, 3.0)
    assert plotting.limits(np.full(3, np.nan)) == (0.0, 1.0)
    low, high = plotting.limits(np.full(5, 7.0))
    assert low == 7.0
    assert high > low
