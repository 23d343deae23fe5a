"""Reduce a phantom's folder to the sample: all photos as they are, the cube cropped, some of its bands, its truth.

python samples/make_sample.py PHANTOM_FOLDER [TARGET_FOLDER]
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np

from specimap_core.atomic import atomic_path
from specimap_core.cube import open_cube
from specimap_validation.phantom import write_cube

# The crop is symmetric about the cube's centre, so that the principal point stays in the middle of the image; it
# keeps all four cards with a margin. Pixels are not binned: their centres stay where they were.
CROP_ROWS = slice(40, 472)
CROP_COLS = slice(88, 552)
BANDS = slice(3, None, 4)
XYZ_STEPS_PER_MM = 256
"""Truth is rounded to 1/256 mm: zeros at the end of each float32 compress, and 0.002 mm does not show."""
ABUNDANCE_STEPS = 64


def reduce_cube(source: Path, target: Path) -> None:
    """Crop ``source`` (an ENVI header), keep some bands, write header and data at ``target``."""
    cube = open_cube(source)
    values = cube.read_rows(0, cube.rows)[CROP_ROWS, CROP_COLS, BANDS]
    write_cube(np.ascontiguousarray(values), cube.wavelengths_nm[BANDS], target, interleave="bsq")


def reduce_truth(source: Path, target: Path, photo_size: tuple[int, int]) -> None:
    """The keys of ``truth.npz`` that :func:`specimap_validation.phantom.load_truth` reads, cropped as the cube is.

    ``photo_size``: width, height.
    """
    with np.load(source, allow_pickle=False) as z:
        kept = {
            k: z[k]
            for k in (
                "marker_ids",
                "marker_corners",
                "marker_length",
                "rgb_K",
                "rgb_R",
                "rgb_t",
                "rgb_dist",
                "rgb_files",
                "hsi_R",
                "hsi_t",
                "hsi_dist",
                "materials",
            )
        }
        K = z["hsi_K"].copy()
        K[:2, 2] -= [CROP_COLS.start, CROP_ROWS.start]
        xyz = z["hsi_xyz"][CROP_ROWS, CROP_COLS]
        abundance = z["hsi_abundance"][CROP_ROWS, CROP_COLS].astype(np.float32)
        bands = np.arange(len(z["wavelengths"]))[BANDS]
        dead = z["dead_pixels"] - [CROP_ROWS.start, CROP_COLS.start]
        inside = ((dead >= 0) & (dead < xyz.shape[:2])).all(1)
        kept |= {
            "rgb_size": np.tile(photo_size, (len(z["rgb_files"]), 1)),
            "hsi_K": K,
            "hsi_size": np.array(xyz.shape[1::-1]),
            "hsi_xyz": (np.round(xyz * XYZ_STEPS_PER_MM) / XYZ_STEPS_PER_MM).astype(np.float32),
            "hsi_class": z["hsi_class"][CROP_ROWS, CROP_COLS],
            "hsi_abundance": (np.round(abundance * ABUNDANCE_STEPS) / ABUNDANCE_STEPS).astype(np.float16),
            "endmembers": z["endmembers"][:, BANDS],
            "wavelengths": z["wavelengths"][BANDS],
            "bad_bands": np.flatnonzero(np.isin(bands, z["bad_bands"])),
            "dead_pixels": dead[inside],
        }
    with atomic_path(target) as aside, open(aside, "wb") as f:
        np.savez_compressed(f, allow_pickle=False, **kept)


def main(phantom: Path, target: Path) -> None:
    """Make the sample of ``phantom`` in ``target``."""
    from PIL import Image

    photos = sorted((phantom / "rgb").glob("*.jpg"))
    with Image.open(photos[0]) as image:
        size = image.size
    (target / "rgb").mkdir(parents=True, exist_ok=True)
    for photo in photos:
        shutil.copyfile(photo, target / "rgb" / photo.name)
    reduce_cube(phantom / "hsi" / "hsi.hdr", target / "hsi" / "hsi.hdr")
    reduce_truth(phantom / "truth.npz", target / "truth.npz", size)


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) == 3 else Path(__file__).parent)
