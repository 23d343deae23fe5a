"""One root error; each leaf has a stable code.

``SpecimapError`` carries a message (what is wrong), an advice (what to do) and details (JSON values that a
program can use). A leaf also is the builtin that fits, so that ``except FileNotFoundError`` works.
"""

from __future__ import annotations

from typing import ClassVar


class SpecimapError(Exception):
    """Root of all errors that Specimap raises on purpose."""

    code: ClassVar[str] = "internal_error"

    def __init__(self, message: str, *, advice: str = "", **details: object) -> None:
        super().__init__(message)
        self.message = message
        self.advice = advice
        self.details = details

    def __str__(self) -> str:
        return f"{self.message} {self.advice}".strip()

    def __reduce__(self) -> tuple[object, ...]:
        # Keyword-only arguments do not survive the default pickling, and workers pass errors on.
        return (_rebuild, (type(self), self.message, self.advice, self.details))

    def as_dict(self) -> dict[str, object]:
        """Code, message, advice and details as JSON-ready values."""
        return {"code": self.code, "message": self.message, "advice": self.advice, "details": self.details}


def _rebuild(leaf: type[SpecimapError], message: str, advice: str, details: dict[str, object]) -> SpecimapError:
    return leaf(message, advice=advice, **details)


# ---- photos -------------------------------------------------------------------------------------------


class PhotoUnreadableError(SpecimapError, ValueError):
    """A photo does not decode: not an image, truncated, or too large."""

    code = "photo_unreadable"


class PhotoRawError(PhotoUnreadableError):
    """A photo is a raw file: a sensor's readings, not a picture."""

    code = "photo_raw"


class PhotoTooLargeError(PhotoUnreadableError):
    """A photo has more pixels than are decoded; ``details['limit_pixels']``."""

    code = "photo_too_large"


class TooFewPhotosError(SpecimapError, ValueError):
    """Fewer photos than the minimum, as given or after refusing some."""

    code = "too_few_photos"


class PhotosNotConnectedError(SpecimapError, ValueError):
    """The photos fall into groups that share nothing: two scenes."""

    code = "photos_not_connected"


class DepthNotFoundError(SpecimapError, ValueError):
    """No pair of photos gave a surface."""

    code = "depth_not_found"


# ---- markers ------------------------------------------------------------------------------------------


class NoMarkersFoundError(SpecimapError, ValueError):
    """No photo shows a marker of the dictionary."""

    code = "no_markers_found"


class WrongDictionaryError(NoMarkersFoundError):
    """Markers are seen, but they belong to another dictionary, which is named."""

    code = "marker_dictionary_wrong"


class UnknownDictionaryError(SpecimapError, ValueError):
    """The named dictionary does not exist."""

    code = "marker_dictionary_unknown"


class DuplicateMarkersError(SpecimapError, ValueError):
    """One id stands on several markers."""

    code = "marker_ids_duplicate"


class MarkersMissingInCubeError(SpecimapError, ValueError):
    """Fewer than two markers that the photos know show in the cube."""

    code = "markers_missing_in_cube"


class MarkerGeometryError(SpecimapError, ValueError):
    """The markers seen do not determine the cameras."""

    code = "marker_geometry_unsolvable"


class EdgeImplausibleError(SpecimapError, ValueError):
    """The marker edge puts the cameras where none can have been; ``details['distance_mm']`` says where."""

    code = "edge_implausible"


# ---- cube ---------------------------------------------------------------------------------------------


class CubeHeaderError(SpecimapError, ValueError):
    """A header field is missing or wrong; ``details['field']`` names it."""

    code = "cube_header_invalid"


class CubeTruncatedError(SpecimapError, ValueError):
    """The data are shorter than the header says; details hold expected and found bytes."""

    code = "cube_truncated"


class CubeNotFoundError(SpecimapError, FileNotFoundError):
    """The cube, or the data next to its header, does not exist."""

    code = "cube_not_found"


class CubeNotReadableError(SpecimapError, PermissionError):
    """The cube, or the data next to its header, may not be read by this user; details hold the path."""

    code = "cube_not_readable"


class CubeFormatError(SpecimapError, ValueError):
    """The file is of no known cube format, or holds no cube.

    So are files with a compression that is not supported, with values in other files, and with several arrays of
    which nothing tells the cube.
    """

    code = "cube_format_unknown"


class CubeContentError(SpecimapError, ValueError):
    """The cube reads, but holds nothing usable: no finite or varying values, or a reference that does not fit."""

    code = "cube_content_invalid"


class RegistrationError(SpecimapError, ValueError):
    """The cube's camera cannot be solved, or its rays miss the surface."""

    code = "registration_failed"


class ResultInsufficientError(SpecimapError, ValueError):
    """Hardly a pixel between the markers got a place: the result would be of no use; details hold the figures."""

    code = "result_insufficient"


# ---- cloud --------------------------------------------------------------------------------------------


class CloudDamagedError(SpecimapError, ValueError):
    """A stored cloud lacks an array, or its bytes do not decode; ``details['array']`` names it where known."""

    code = "cloud_damaged"


class LabelInvalidError(SpecimapError, ValueError):
    """Labels do not fit the cloud: their number, a class that is not named, a probability outside 0..1."""

    code = "label_invalid"


# ---- the program --------------------------------------------------------------------------------------


class SettingsError(SpecimapError, ValueError):
    """A setting is out of its range; ``details['setting']`` names it."""

    code = "setting_invalid"


class BackendUnavailableError(SpecimapError, RuntimeError):
    """The backend, or a library or weights file it needs, is not there."""

    code = "backend_unavailable"


class OutputExistsError(SpecimapError, FileExistsError):
    """The output folder holds something that Specimap did not write."""

    code = "output_exists"


class OutputNotWritableError(SpecimapError, PermissionError):
    """The output folder cannot be written."""

    code = "output_not_writable"


class StorageFullError(SpecimapError, OSError):
    """The disk filled up; nothing half-written remains."""

    code = "storage_full"


class NotFoundError(SpecimapError, FileNotFoundError):
    """What was asked for is not there."""

    code = "not_found"


class CancelledError(SpecimapError, RuntimeError):
    """The run was cancelled; finished stages are kept."""

    code = "cancelled"


class BackendFailedError(SpecimapError, RuntimeError):
    """The process of a backend crashed or ran out of memory; details hold its last lines."""

    code = "backend_failed"


class StageFailedError(SpecimapError, RuntimeError):
    """A library failed inside a stage, on an input that no check foresaw; details name the stage."""

    code = "stage_failed"


class MemoryExhaustedError(SpecimapError, MemoryError):
    """A stage needs more memory than it may take."""

    code = "memory_exhausted"
