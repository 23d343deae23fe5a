"""Notices: findings that do not stop a run, and the one catalogue of their codes.

A report, a cube and a reconstruction carry theirs as ``warnings``. This module is light: the service imports it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, Literal


def few_of(names: Sequence[str], most: int = 6) -> str:
    """The first ``most`` names in a row, and how many more there are."""
    shown = ", ".join(names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


@dataclass(frozen=True, slots=True)
class Notice:
    """Something that a reader of the result should know."""

    __pydantic_config__: ClassVar[dict[str, str]] = {"extra": "forbid"}

    code: str
    message: str


Notices = tuple[Notice, ...]

Origin = Literal["photos", "reconstruct", "cube", "references", "register", "cloud", "result"]
"""Where a notice arises: the photos' folder, stage 1, the cube's file (in a run and when it is uploaded), the white and
dark references, stage 4, the spectra while they are written, or the report's own figures."""


@dataclass(frozen=True, slots=True)
class NoticeKind:
    """``origin`` and ``meaning`` of a code."""

    origin: Origin
    meaning: str


CATALOGUE = MappingProxyType(
    {
        "files_passed_over": NoticeKind("photos", "the photos' folder holds files that are no photos, or folders"),
        "focal_breathing": NoticeKind("reconstruct", "the photos' focal lengths differ; this was accounted for"),
        "features_chosen": NoticeKind("reconstruct", "markers alone did not pose all photos; image features were used"),
        "dense_on_gpu": NoticeKind("reconstruct", "depth was measured on a GPU"),
        "dense_gpu_failed": NoticeKind("reconstruct", "the GPU failed; depth was measured on the CPU"),
        "backend_run": NoticeKind("reconstruct", "a network ran: its device, its time and the hash of its weights"),
        "depth_unaligned": NoticeKind("reconstruct", "a network's depth of some photos fits nothing and is left out"),
        "licence_apache": NoticeKind("reconstruct", "the network is under the Apache licence"),
        "licence_non_commercial": NoticeKind("reconstruct", "the network's licence allows non-commercial use only"),
        "single_band": NoticeKind("cube", "the cube has one band only"),
        "bands_all_zero": NoticeKind("cube", "some bands hold zeros only"),
        "pixels_nan": NoticeKind("cube", "some pixels hold no value in any good band"),
        "values_nan": NoticeKind("cube", "some pixels lack values in some bands"),
        "pixels_zero": NoticeKind("cube", "some pixels are zero in all good bands"),
        "saturated": NoticeKind("cube", "some pixels are saturated in at least one band"),
        "no_data_impossible": NoticeKind("cube", "the data type cannot hold the file's no-data value"),
        "no_data_undeclared": NoticeKind("cube", "a usual no-data value that the file does not declare fills pixels"),
        "values_absurd": NoticeKind("cube", "some values lie far beyond all others and are taken for no value"),
        "detector_dead": NoticeKind("cube", "some detector elements are dead; their values are taken for no value"),
        "scale_assumed": NoticeKind("cube", "the file's scale can be read in two ways; one was taken"),
        "reflectance_factor_unused": NoticeKind("cube", "the file names a reflectance factor, but holds reflectance"),
        "reflectance_implausible": NoticeKind("cube", "reflectance is far too low, too high or negative"),
        "quantity_not_reflectance": NoticeKind("cube", "the file calls its values another quantity than reflectance"),
        "wavelengths_missing": NoticeKind("cube", "the file names no wavelengths"),
        "wavelengths_count_mismatch": NoticeKind("cube", "the file names more or fewer wavelengths than bands"),
        "wavelengths_invalid": NoticeKind("cube", "the wavelengths are not all positive numbers"),
        "wavelengths_band_numbers": NoticeKind("cube", "the file's wavelengths are the numbers of the bands"),
        "wavelengths_implausible": NoticeKind("cube", "the wavelengths lie outside 100 nm to 100 um"),
        "wavelength_units_contradict": NoticeKind("cube", "the wavelengths' unit contradicts their numbers"),
        "wavelength_units_unknown": NoticeKind("cube", "the wavelengths' unit is not known"),
        "wavelengths_repeated": NoticeKind("cube", "several bands have the same wavelength"),
        "wavelengths_unordered": NoticeKind("cube", "the wavelengths do not rise or fall steadily"),
        "dataset_chosen": NoticeKind("cube", "the file holds several arrays that could be the cube; one was taken"),
        "values_lossy": NoticeKind("cube", "the file's compression changes values"),
        "bad_bands_count_mismatch": NoticeKind("cube", "the bad-band list does not fit the number of bands"),
        "bad_bands_all": NoticeKind("cube", "the bad-band list marks every band as bad"),
        "byte_order_assumed": NoticeKind("cube", "the file does not state its byte order; one was assumed"),
        "axes_assumed": NoticeKind("cube", "the file does not name its axes; they were assumed"),
        "data_longer_than_header": NoticeKind("cube", "the data hold more bytes than the header says"),
        "dark_missing": NoticeKind("references", "no dark reference was given; a dark signal of zero is assumed"),
        "reference_invalid": NoticeKind(
            "references", "in places the white reference is not brighter than the dark one"
        ),
        "reference_units_differ": NoticeKind("references", "some of cube and references are counts, some reflectance"),
        "reference_exposure_differs": NoticeKind(
            "references", "a reference was exposed longer or shorter than the cube"
        ),
        "white_wavelengths_differ": NoticeKind("references", "the white reference's wavelengths are not the cube's"),
        "dark_wavelengths_differ": NoticeKind("references", "the dark reference's wavelengths are not the cube's"),
        "white_saturated": NoticeKind("references", "the white reference is saturated"),
        "few_photos": NoticeKind("register", "fewer photos were used than are recommended"),
        "scale_implausible": NoticeKind("register", "the marker edge puts the cameras at an unusual distance"),
        "scale_contradicts_exif": NoticeKind("register", "EXIF states another distance than the marker edge gives"),
        "markers_missing_in_cube": NoticeKind("register", "a marker of the photos does not show in the cube"),
        "markers_not_in_band_mean": NoticeKind("register", "the markers show best in other bands than the mean of all"),
        "cube_mirrored": NoticeKind("register", "the cube is mirrored; this was accounted for"),
        "cube_pixels_not_square": NoticeKind("register", "the cube's pixels are not square; this was accounted for"),
        "cube_camera_not_frame": NoticeKind("register", "the cube was recorded by a push-broom camera"),
        "cube_camera_loose": NoticeKind("register", "the markers leave the cube's camera open"),
        "cube_camera_unfit": NoticeKind("register", "no camera model fits the markers and the specimen in the cube"),
        "marker_moved": NoticeKind(
            "register", "a marker lies elsewhere in the cube than in the photos; it was left out"
        ),
        "specimen_moved": NoticeKind("register", "the specimen moved between the photos and the cube"),
        "points_no_data": NoticeKind("cloud", "some points lack a value in a good band"),
        "values_clipped": NoticeKind("cloud", "some values were stored as the least or the largest that a cloud holds"),
        "coverage_low": NoticeKind("result", "too few of the cube's pixels between the markers have a point"),
        "specimen_not_found": NoticeKind("result", "nothing rises above the markers' plane as a specimen does"),
        "corners_scatter": NoticeKind("result", "the photos contradict each other"),
        "photo_outlying": NoticeKind(
            "result", "in some photos the markers' corners lie far more off than in the others"
        ),
        "cube_corners_scatter": NoticeKind("result", "the cube's corners lie far from where its camera puts them"),
        "photos_contradict": NoticeKind("result", "photos show the specimen elsewhere than the other photos predict"),
        "photo_contradicts": NoticeKind("result", "single photos show the specimen where the others do not predict it"),
        "photos_unpredicted": NoticeKind("result", "most of the photos do not resemble what the others predict"),
        "surface_leans": NoticeKind("result", "unused photos show the whole surface higher or lower"),
        "surface_unchecked": NoticeKind("result", "too few photos were left to check the surface with"),
        "seen_error_large": NoticeKind("result", "unused photos and the cube's picture show large errors"),
        "cube_picture_off": NoticeKind("result", "the cube's picture lies off the photos' colours"),
        "bands_shifted": NoticeKind("result", "the cube's bands are shifted or stretched against each other"),
    }
)
"""Every code with its origin and meaning; :mod:`specimap_core.report.wording` holds the advice on each."""
RETIRED = frozenset({"dense_on_gpu", "dense_gpu_failed"})
"""Codes in reports and artefacts of earlier versions that are given no more."""
