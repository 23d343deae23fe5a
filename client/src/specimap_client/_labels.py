"""Label layers of a cloud: a class or probabilities for each point, in versions."""

from __future__ import annotations

import datetime
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from specimap_client._decode import Model
from specimap_client._http import Session, json_of, path
from specimap_client._spectra_answers import NPY, npy_of


@dataclass(frozen=True, kw_only=True)
class LabelClass(Model):
    """A class: its value in the layer, its name, its colour as ``#rrggbb``; without one it is not drawn."""

    value: int
    name: str
    colour: str | None = None


@dataclass(frozen=True, kw_only=True)
class Label(Model):
    """One version of a layer. ``kind`` is ``class`` or ``probability``; ``made_by`` says what made it."""

    cloud_id: str
    name: str
    version: int
    kind: str
    classes: tuple[LabelClass, ...]
    made_by: dict[str, Any]
    created_at: datetime.datetime
    created_by: str
    _session: Session | None = field(default=None, repr=False, compare=False)

    def values(self) -> NDArray[Any]:
        """Classes (S,), or probabilities (S,) or (S, C), of all points."""
        assert self._session is not None, "labels come from the service"
        address = path("clouds", self.cloud_id, "labels", self.name, "values")
        answer = self._session.request("GET", address, params={"version": self.version}, headers={"Accept": NPY})
        return npy_of(answer)


ClassLike = LabelClass | tuple[int | str | None, ...]
"""A class, or its value and name, or its value, name and colour."""


def bound(session: Session, data: object) -> Label:
    """A label of an answer, which can fetch its values."""
    return replace(Label.of(data), _session=session)


def put_label(
    session: Session,
    cloud: str,
    points: int,
    name: str,
    values: ArrayLike,
    classes: Sequence[ClassLike],
    made_by: Mapping[str, Any] | str,
    if_version: int | None,
) -> Label:
    """See :meth:`Cloud.put_label`."""
    array = np.asarray(values)
    floating = np.issubdtype(array.dtype, np.floating)
    if not floating and not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"values are of the type {array.dtype}: give integers for classes, floats for probabilities")
    if array.ndim not in ((1, 2) if floating else (1,)) or len(array) != points:
        raise ValueError(f"values have the shape {array.shape}, but the cloud has {points} points")
    metadata = {
        "kind": "probability" if floating else "class",
        "classes": [_class(item) for item in classes],
        "made_by": {"name": made_by} if isinstance(made_by, str) else dict(made_by),
    }
    # Plain ASCII: a header carries nothing else safely.
    headers = {"Content-Type": NPY, "X-Specimap-Label": json.dumps(metadata, ensure_ascii=True, allow_nan=False)}
    if if_version == 0:
        headers["If-None-Match"] = "*"
    elif if_version is not None:
        headers["If-Match"] = f'"{if_version}"'
    body = io.BytesIO()
    np.lib.format.write_array(body, np.ascontiguousarray(array), allow_pickle=False)
    address = path("clouds", cloud, "labels", name)
    return bound(session, json_of(session.request("PUT", address, content=body.getvalue(), headers=headers)))


def _class(item: ClassLike) -> dict[str, Any]:
    if isinstance(item, LabelClass):
        item = (item.value, item.name, item.colour)
    if len(item) not in (2, 3):
        raise ValueError(f"a class is (value, name) or (value, name, colour), not {item}")
    described = dict(zip(("value", "name", "colour"), item, strict=False))
    return {name: value for name, value in described.items() if value is not None}
