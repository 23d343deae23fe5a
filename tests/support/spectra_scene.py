"""A service with a cloud of several batches of rows, and answers read back as arrays."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pyarrow as pa

from specimap_core.cloud import Cloud
from specimap_service.array_responses import BATCH
from tests.support.cloud_scene import FakeCube, counts, scene
from tests.support.result_scene import put_result
from tests.support.service_scene import serving

ROWS, COLS, BANDS = 160, 140, 5


@contextmanager
def large_cloud(folder: Path) -> Iterator[tuple[httpx.Client, Cloud]]:
    """A client whose base URL is the cloud's, and the test's own copy of the cloud."""
    with serving(folder / "service") as running:
        cube = FakeCube(counts(ROWS, COLS, BANDS))
        result = put_result(running, folder / "result", cube=cube, points=scene(ROWS, COLS, 0.9))
        assert result.cloud.n_points > 4 * BATCH
        client = running.client(("read",), rate_per_minute=1_000_000)
        client.base_url = httpx.URL(f"{running.url}/v1/clouds/{result.cloud_id}/")
        yield client, result.cloud


def read(reader: httpx.Client, accept: str, select: dict[str, Any], **more: Any) -> httpx.Response:
    """The answer to a selection, in the form asked for."""
    answer = reader.post("spectra", json={"select": select, **more}, headers={"Accept": accept})
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == accept
    return answer


def table_of(answer: httpx.Response) -> tuple[pa.Table, dict[str, np.ndarray]]:
    """An Arrow stream as a table, and its columns as arrays (n,) or (n, m)."""
    table = pa.ipc.open_stream(answer.content).read_all()
    columns = {}
    for name in table.column_names:
        column = table[name].combine_chunks()
        if pa.types.is_fixed_size_list(column.type):
            columns[name] = column.flatten().to_numpy().reshape(len(column), column.type.list_size)
        else:
            columns[name] = column.to_numpy()
    return table, columns
