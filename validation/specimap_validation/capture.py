"""Acquisitions in a folder: photos, a cube, and truth where it is known."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from specimap_core.errors import CubeNotFoundError, NotFoundError
from specimap_core.photos.folder import photo_paths

PHOTO_FOLDERS = ("rgb", "photos")
CUBE_FOLDERS = ("hsi", "cube")
_TRUTH = "truth.npz"


@dataclass(frozen=True)
class Capture:
    """``folder`` with its ``photos`` and its ``cube``; ``has_truth``: whether it holds truth."""

    folder: Path
    photos: tuple[Path, ...]
    cube: Path
    has_truth: bool

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.folder.resolve().name


def find_capture(folder: Path) -> Capture:
    """Find photos in ``rgb/`` or ``photos/``, and the cube: the one header in ``hsi/`` or ``cube/``, else ``cube.*``.

    Raises:
        NotFoundError: there is no such folder, or none for photos in it.
        TooFewPhotosError: the folder for photos holds none.
        CubeNotFoundError: there is no cube, or several.
    """
    if not folder.is_dir():
        raise NotFoundError(f"There is no folder {folder}.", advice="Name the folder of an acquisition.")
    photos = next((folder / name for name in PHOTO_FOLDERS if (folder / name).is_dir()), None)
    if photos is None:
        raise NotFoundError(
            f"{folder} holds no folder of photos.", advice=f"Put the photos into {folder.name}/{PHOTO_FOLDERS[0]}."
        )
    return Capture(folder, tuple(photo_paths(photos)), _cube(folder), (folder / _TRUTH).is_file())


def _cube(folder: Path) -> Path:
    found = sorted(p for name in CUBE_FOLDERS for p in (folder / name).glob("*.hdr"))
    found = found or sorted(p for p in folder.glob("cube.*") if p.is_file() and p.suffix not in (".raw", ".dat"))
    headers = [p for p in found if p.suffix == ".hdr"]
    if headers:
        found = headers
    if len(found) != 1:
        what = "no cube" if not found else f"{len(found)} cubes"
        raise CubeNotFoundError(
            f"{folder} holds {what}.", advice=f"Put one ENVI header with its data into {folder.name}/{CUBE_FOLDERS[0]}."
        )
    return found[0]
