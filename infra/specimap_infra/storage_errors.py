"""Keys of the storage, checked, and the errors of reading and writing it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import obstore

from specimap_core.atomic import disk_errors
from specimap_core.errors import NotFoundError, OutputNotWritableError, StorageFullError
from specimap_infra.errors import StorageUnavailableError

PART = re.compile(r"^[A-Za-z0-9_=-][A-Za-z0-9._=-]{0,254}$")
"""No longer than a file's name may be."""
LONGEST_KEY = 900
"""Characters: S3 takes 1024 bytes, with the prefix of the settings."""


def checked(key: str) -> str:
    """Return the key, if it is made of safe names. Raises NotFoundError: no other key ever exists."""
    parts = key.split("/")
    # A store's refusal of a name that is too long would look like its absence.
    if len(key) > LONGEST_KEY or not all(PART.match(part) for part in parts):
        raise not_found(key)
    return key


def not_found(key: str) -> NotFoundError:
    """Make the error for a key without a file."""
    return NotFoundError(f"There is no {key[:200]!r} in the storage.", advice="It may have been deleted.")


@contextmanager
def store_errors(key: str) -> Iterator[None]:
    """Turn errors of the disk and the store into NotFoundError, StorageFullError and StorageUnavailableError."""
    try:
        with disk_errors(Path(key)):
            yield
    except (StorageFullError, StorageUnavailableError, NotFoundError):
        raise
    except FileNotFoundError as error:
        raise not_found(key) from error
    except OutputNotWritableError as error:
        if isinstance(error.__cause__, FileNotFoundError | NotADirectoryError):
            raise not_found(key) from error
        raise _unavailable(error) from error
    except (obstore.exceptions.BaseError, OSError) as error:
        if "No space left" in str(error) or "os error 28" in str(error):
            raise StorageFullError("The storage is full.", advice="Free space; finished results are kept.") from error
        raise _unavailable(error) from error


def is_away(error: BaseException) -> bool:
    """Whether an error tells that the store is away, not that it answers by a refusal."""
    return isinstance(error, StorageUnavailableError) and isinstance(
        error.__cause__, obstore.exceptions.GenericError | OSError | OutputNotWritableError
    )


def _unavailable(error: Exception) -> StorageUnavailableError:
    # The store's own message may name buckets and accounts: it goes to the log with the traceback.
    return StorageUnavailableError(
        f"The storage does not answer, or cannot be written ({type(error).__name__}).", advice="Try again later."
    )
