"""List the photos of a folder by the ends of their names; other files are named as passed over."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from specimap_core.atomic import name_as_text
from specimap_core.errors import NotFoundError, TooFewPhotosError
from specimap_core.notices import Notice
from specimap_core.photos.formats import NAMES, PHOTO_SUFFIXES, RAW_SUFFIXES

MOST_NAMED = 20
"""Files that are named one by one where some were passed over."""


@dataclass(frozen=True)
class PhotoFolder:
    """``photos`` by name, raw files among them; ``passed_over``: (name, why) of what else lies there, hidden files
    aside."""

    photos: list[Path]
    passed_over: tuple[tuple[str, str], ...]

    def warnings(self) -> list[Notice]:
        """A warning for the report where something was passed over."""
        if not self.passed_over:
            return []
        named = "; ".join(f"{name} ({why})" for name, why in self.passed_over[:MOST_NAMED])
        rest = len(self.passed_over) - MOST_NAMED
        return [Notice("files_passed_over", f"Not read: {named}{f'; and {rest} more' if rest > 0 else ''}.")]


def photo_folder(folder: Path) -> PhotoFolder:
    """What a folder holds: photos by the ends of their names, and what is no photo. Folders in it are not entered: they
    hold edited copies and other specimens as often as photos.

    Raises:
        NotFoundError: there is no such folder, or it may not be read.
    """
    if not folder.is_dir():
        raise NotFoundError(f"There is no folder {folder}.", advice="Name the folder that holds the photos.")
    photos: list[Path] = []
    passed_over: list[tuple[str, str]] = []
    try:
        for path in sorted(p for p in folder.iterdir() if not p.name.startswith(".")):
            if path.is_dir():
                passed_over.append((name_as_text(path), _what_holds(path)))
            elif not path.is_file():
                passed_over.append((name_as_text(path), "no regular file"))
            elif _is_photo(path):
                photos.append(path)
            else:
                passed_over.append((name_as_text(path), "its name does not end as a photo's"))
    except PermissionError as error:
        raise NotFoundError(
            f"{folder} may not be read.", advice="Let the account that runs Specimap read the folder."
        ) from error
    return PhotoFolder(photos, tuple(passed_over))


def _is_photo(path: Path) -> bool:
    return path.suffix.lower() in PHOTO_SUFFIXES | RAW_SUFFIXES and not path.name.startswith(".")


def _what_holds(folder: Path) -> str:
    try:
        count = sum(_is_photo(path) for path in folder.iterdir())
    except OSError:
        return "a folder that may not be read"
    return f"a folder with {count} photo{'s' * (count != 1)}" if count else "a folder"


def photo_paths(folder: Path) -> list[Path]:
    """The photos in a folder by name.

    Raises:
        NotFoundError: there is no such folder.
        TooFewPhotosError: it holds no photo.
    """
    found = photo_folder(folder)
    if not found.photos:
        raise TooFewPhotosError(
            " ".join([f"{folder} holds no photo.", *(warning.message for warning in found.warnings())]),
            advice=f"Name the folder that holds the photos themselves: {NAMES}.",
            found=0,
        )
    return found.photos
