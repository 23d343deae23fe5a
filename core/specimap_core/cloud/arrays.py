"""The arrays of a stored cloud, read when they are first asked for."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np
import zarr
from numpy.typing import NDArray

from specimap_core.arrays import Array
from specimap_core.cloud.schema import ARRAYS
from specimap_core.cloud.shards import PointArray, damage
from specimap_core.cloud.source import ByteSource, Folder
from specimap_core.errors import CloudDamagedError, NotFoundError


@dataclass(frozen=True, eq=False)
class CloudArrays:
    """The arrays of an open cloud. They are read when they are first asked for, and kept; spectra are never kept.

    ``source``: the group's files; ``attributes``: its attributes. Safe to share between threads that read.
    """

    source: ByteSource
    attributes: Mapping[str, object]

    @classmethod
    def open(cls, group: Path | ByteSource) -> Self:
        """Open the group in a folder, or from any other source of its bytes.

        Raises NotFoundError where there is no cloud, CloudDamagedError where it is not whole.
        """
        source: ByteSource = Folder(group) if isinstance(group, Path) else group
        try:
            metadata = json.loads(source.read("zarr.json"))
            if metadata["node_type"] != "group":
                raise ValueError(f"it is of the type {metadata['node_type']}")
            attributes = dict(metadata.get("attributes", {}))
        except (FileNotFoundError, NotADirectoryError) as error:
            where = source.path if isinstance(source, Folder) else source.name
            raise NotFoundError(
                f"There is no cloud at {where}.", advice="Check the path, or that the run has finished."
            ) from error
        except (OSError, ValueError, LookupError, AttributeError, TypeError) as error:
            raise CloudDamagedError(
                f"{source.name} is not a readable Zarr group: {error}.",
                advice="Repeat the run; finished stages are not repeated.",
            ) from error
        missing = [name for name in ARRAYS if not _exists(source, f"{name}/zarr.json")]
        if missing:
            raise CloudDamagedError(
                f"{source.name} lacks the arrays {', '.join(missing)}: it is no cloud, or not whole.",
                advice="Repeat the run; finished stages are not repeated.",
                array=missing[0],
            )
        cloud = cls(source, attributes)
        sizes = {name: cloud.array(name).shape[0] for name, spec in ARRAYS.items() if spec.dimensions[0] == "point"}
        if len(set(sizes.values())) > 1 or len(cloud.array("spectra").shape) != 2:
            raise CloudDamagedError(
                f"The arrays of {source.name} differ in length.", advice="Repeat the run.", lengths=sizes
            )
        return cloud

    # ---- what it holds --------------------------------------------------------------------------------

    @property
    def path(self) -> Path:
        """The group's folder. Raises ValueError where the cloud does not lie in one."""
        if not isinstance(self.source, Folder):
            raise ValueError(f"{self.source.name} is not in a folder")
        return self.source.path

    @property
    def kept_bytes(self) -> int:
        """Memory of the arrays read so far."""
        # A copy: other threads read further arrays meanwhile.
        return sum(values.nbytes for values in list(vars(self).values()) if isinstance(values, np.ndarray))

    @property
    def n_points(self) -> int:
        """Points."""
        return self._spectra.shape[0]

    @property
    def bands(self) -> int:
        """Bands."""
        return self._spectra.shape[1]

    @property
    def report(self) -> Mapping[str, object]:
        """The registration's report; empty where the cloud was written without one."""
        report = self.attributes.get("report")
        return report if isinstance(report, dict) else {}

    @property
    def quantity(self) -> str:
        """What decoded values are: ``reflectance``, ``counts``."""
        return str(self._spectra.attributes.get("quantity", "counts"))

    @property
    def scale_factor(self) -> float:
        """Decoded = stored * scale_factor + add_offset."""
        return _number(self._spectra.attributes.get("scale_factor"), 1.0)

    @property
    def add_offset(self) -> float:
        """See :attr:`scale_factor`."""
        return _number(self._spectra.attributes.get("add_offset"), 0.0)

    @property
    def fill_value(self) -> int | None:
        """The stored value that stands for none; None where each one is a value."""
        value = self._spectra.attributes.get("_FillValue")
        return value if isinstance(value, int) else None

    @property
    def bad_bands(self) -> NDArray[np.bool_]:
        """Bands (B,) that the cube's file or its noise declared useless."""
        mask = np.zeros(self.bands, bool)
        listed = self.attributes.get("bad_bands")
        if isinstance(listed, list):
            mask[[int(band) for band in listed if 0 <= int(band) < self.bands]] = True
        return mask

    @cached_property
    def wavelengths_nm(self) -> NDArray[np.float32]:
        """(B,) nm, NaN where unknown."""
        return self._whole("wavelength_nm")

    @cached_property
    def xyz(self) -> NDArray[np.float32]:
        """(S, 3) mm, marker frame."""
        return self._whole("xyz")

    @cached_property
    def normal(self) -> NDArray[np.float32]:
        """(S, 3), unit."""
        return self._whole("normal")

    @cached_property
    def rgb(self) -> NDArray[np.uint8]:
        """(S, 3), from the photos."""
        return self._whole("rgb")

    @cached_property
    def sigma_mm(self) -> NDArray[np.float32]:
        """(S,) one standard deviation of the position."""
        return self._whole("sigma_mm")

    @cached_property
    def flags(self) -> NDArray[np.uint8]:
        """(S,) bits of :class:`~specimap_core.cloud.schema.Flag`."""
        return self._whole("flags")

    @cached_property
    def hsi_pixel(self) -> NDArray[np.uint16]:
        """(S, 2) row, column in the cube."""
        return self._whole("hsi_pixel")

    @cached_property
    def chunk_aabb(self) -> NDArray[np.float32]:
        """(chunks, 6) mm: minimum, then maximum of each 256 points."""
        return self._whole("chunk_aabb")

    @property
    def label_names(self) -> tuple[str, ...]:
        """Labels that classifiers wrote into the group, where it is a folder."""
        if not isinstance(self.source, Folder):
            return ()
        return tuple(sorted(p.parent.name for p in self.path.glob("labels/*/zarr.json")))

    def label(self, name: str) -> Array:
        """Values (S, ...) of a label. Raises NotFoundError, CloudDamagedError."""
        if name not in self.label_names:
            known = ", ".join(self.label_names) or "none"
            raise NotFoundError(f"The cloud has no label {name!r}.", advice=f"It has {known}.", labels=self.label_names)
        with damage(self.source, f"labels/{name}"):
            return np.asarray(zarr.open_array(self.path / "labels" / name, mode="r")[...])

    # ---- inside ---------------------------------------------------------------------------------------

    def array(self, name: str) -> PointArray:
        """The stored array of that name in :data:`~specimap_core.cloud.schema.ARRAYS`."""
        if name not in self._arrays:
            self._arrays[name] = PointArray(self.source, name)
        return self._arrays[name]

    @cached_property
    def _arrays(self) -> dict[str, PointArray]:
        return {}

    @cached_property
    def _spectra(self) -> PointArray:
        return self.array("spectra")

    def _whole(self, name: str) -> Array:
        array = self.array(name)
        values = array.read(0, array.shape[0])
        values.flags.writeable = False
        return values


def _exists(source: ByteSource, key: str) -> bool:
    try:
        source.size(key)
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def _number(value: object, default: float) -> float:
    return float(value) if isinstance(value, int | float) else default
