"""Bands and class probabilities as a Parametric Map of float32, on the grid of the top view."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import highdicom as hd
import numpy as np
from highdicom.sr import CodedConcept
from pydicom import Dataset
from pydicom.uid import ExplicitVRLittleEndian

from specimap_core.arrays import Array, Singles
from specimap_core.cloud import Cloud
from specimap_core.errors import NotFoundError, SettingsError
from specimap_hospital.dicom import codes
from specimap_hospital.dicom.codes import own
from specimap_hospital.dicom.files import Written, write_dataset
from specimap_hospital.dicom.header import MANUFACTURER, NO_SERIAL_NUMBER, RESEARCH, Header, Series
from specimap_hospital.dicom.model import BandChoice
from specimap_hospital.dicom.result import Result

NO_VALUE = -1.0
"""In pixels without a point: below any reflectance, count or probability."""
MOST_BYTES = 1 << 30
_NUMBER = 9
_EXPLANATION, _LABEL = 64, 16


@dataclass(frozen=True, eq=False)
class Layer:
    """A frame of the map: values (S,) of the points, what they are, and their unit."""

    values: Array
    label: str
    explanation: str
    quantity: CodedConcept
    unit: CodedConcept


def write_map(header: Header, result: Result, choice: BandChoice, reference: Dataset, target: Path) -> Written:
    """Write the layers that ``choice`` names as the object ``target``, on the reference image.

    Raises:
        NotFoundError: the cloud has no such band, layer or column.
        SettingsError: nothing is chosen, or more than fits into an object.
        StorageFullError, OutputNotWritableError: it cannot be written.
    """
    layers = chosen_layers(result, choice)
    canvas = result.canvas
    frames = np.stack([canvas.means(layer.values) for layer in layers], axis=-1)[None]
    frames[~np.isfinite(frames)] = NO_VALUE
    role = f"map-{choice.label or 'bands'}-{sorted(choice.columns.items()) or choice.bands}"
    series = Series(role, _NUMBER, "OT", f"Map, marker frame, not patient axes ({RESEARCH})")
    known = frames[frames > NO_VALUE]
    low, high = (float(v) for v in np.percentile(known, (1, 99))) if known.size else (0.0, 1.0)
    found = hd.pm.ParametricMap(
        source_images=[reference],
        pixel_array=frames,
        series_instance_uid=header.series_uid(series),
        series_number=series.number,
        sop_instance_uid=header.instance_uid(role),
        instance_number=1,
        manufacturer=MANUFACTURER,
        manufacturer_model_name=MANUFACTURER,
        software_versions=header.source.software_version,
        device_serial_number=NO_SERIAL_NUMBER,
        contains_recognizable_visual_features=False,
        real_world_value_mappings=[[_mapping(layer, frames[..., k])] for k, layer in enumerate(layers)],
        voi_lut_transformations=[_window(low, high)],
        transfer_syntax_uid=ExplicitVRLittleEndian,
        content_label="SPECIMAP_MAP",
        content_description=f"Marker frame, not patient axes; {RESEARCH}",
    )
    found.FloatPixelPaddingValue = found.FloatPixelPaddingRangeLimit = NO_VALUE
    header.put(found, series, role, 1)
    header.put_specimen(found)
    return write_dataset(header, found, "parametric_map", target, ExplicitVRLittleEndian)


def _window(low: float, high: float) -> hd.VOILUTTransformation:
    # The usual function is for whole numbers: it takes no width below 1.
    return hd.VOILUTTransformation((low + high) / 2, max(high - low, 1e-3), voi_lut_function="LINEAR_EXACT")


def chosen_layers(result: Result, choice: BandChoice) -> list[Layer]:
    """The layers that are chosen.

    Raises: as :func:`write_map`.
    """
    cloud, canvas = result.cloud, result.canvas
    count = len(choice.columns) if choice.label else len(choice.bands)
    if not count:
        raise SettingsError("No band is chosen.", advice="Name bands, or a label and its classes.", setting="bands")
    if count * canvas.rows * canvas.cols * 4 > MOST_BYTES:
        most = MOST_BYTES // (canvas.rows * canvas.cols * 4)
        raise SettingsError(
            f"{count} bands are more than fit into one object.", advice=f"Choose at most {most}.", setting="bands"
        )
    return _probabilities(cloud, choice) if choice.label else _bands(cloud, choice.bands)


def _bands(cloud: Cloud, bands: tuple[int, ...]) -> list[Layer]:
    values, known = cloud.band_values(bands), cloud.wavelengths_nm
    reflectance = cloud.quantity == "reflectance"
    quantity = own("reflectance", "Reflectance") if reflectance else own("counts", "Counts of the sensor")
    unit = codes.NO_UNIT if reflectance else codes.COUNTS
    layers = []
    for k, band in enumerate(bands):
        at = f"{known[band]:.1f} nm" if np.isfinite(known[band]) else f"band {band}"
        layers.append(Layer(values[:, k], at, f"{quantity.meaning} at {at}, band {band}", quantity, unit))
    return layers


def _probabilities(cloud: Cloud, choice: BandChoice) -> list[Layer]:
    values = cloud.label(choice.label or "")
    if values.dtype.kind != "f":
        raise SettingsError(
            f"The layer {choice.label} holds classes.", advice="Ask for a segmentation of it.", setting="label"
        )
    columns = values.reshape(len(values), -1)
    missing = [column for column in choice.columns if not 0 <= column < columns.shape[1]]
    if missing:
        raise NotFoundError(
            f"The layer {choice.label} has no column {missing[0]}.", advice=f"Give 0 to {columns.shape[1] - 1}."
        )
    quantity = own("probability", "Probability of a class, by a classifier")
    return [
        Layer(columns[:, column], name[:_LABEL], f"Probability of {name}"[:_EXPLANATION], quantity, codes.NO_UNIT)
        for column, name in choice.columns.items()
    ]


def _mapping(layer: Layer, frame: Singles) -> hd.pm.RealWorldValueMapping:
    low, high = float(frame.min()), float(frame.max())
    return hd.pm.RealWorldValueMapping(
        lut_label=layer.label,
        lut_explanation=layer.explanation,
        unit=layer.unit,
        value_range=(low, max(high, low + 1e-6)),
        slope=1.0,
        intercept=0.0,
        quantity_definition=layer.quantity,
    )
