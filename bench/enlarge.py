"""Photos as a phone's: as many pixels as it gives, of a picture that shows less."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

QUALITY = 92


def enlarge(photos: list[Path], folder: Path, size: tuple[int, int]) -> None:
    """Write each of the square ``photos`` into ``folder`` as a JPEG of ``size`` (width, height), which shows it as
    large as fits, in the middle of grey."""
    folder.mkdir(parents=True, exist_ok=True)
    side = min(size)
    for path in photos:
        with Image.open(path) as photo:
            large = photo.convert("RGB").resize((side, side), Image.Resampling.LANCZOS)
        sheet = Image.new("RGB", size, (90, 90, 90))
        sheet.paste(large, ((size[0] - side) // 2, (size[1] - side) // 2))
        sheet.save(folder / f"{path.stem}.jpg", quality=QUALITY)
