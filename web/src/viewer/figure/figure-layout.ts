/** What stands on a figure besides the picture: sizes and positions. No DOM. */

export interface Tile {
  x: number;
  y: number;
  width: number;
  height: number;
}

/** Cut a picture into tiles that the GPU draws at once. */
export function tilesOf(width: number, height: number, most: number): Tile[] {
  const tiles: Tile[] = [];
  for (let y = 0; y < height; y += most) {
    for (let x = 0; x < width; x += most) tiles.push({ x, y, width: Math.min(most, width - x), height: Math.min(most, height - y) });
  }
  return tiles;
}

/** A round length, mm, that takes at most a quarter of the picture's width. */
export function scaleBar(pixelsPerMm: number, width: number): { mm: number; pixels: number } {
  const most = width / 4 / pixelsPerMm;
  const power = 10 ** Math.floor(Math.log10(most));
  const mm = ([5, 2, 1].find((step) => step * power <= most) ?? 1) * power;
  return { mm, pixels: mm * pixelsPerMm };
}

/** The axes x, y, z as they point on the picture (right, down), the farthest first. `inverse` is column-major. */
export function axesOf(inverse: ArrayLike<number>): { name: "x" | "y" | "z"; right: number; down: number }[] {
  return (["x", "y", "z"] as const)
    .map((name, i) => ({ name, right: inverse[i * 4] ?? 0, down: -(inverse[i * 4 + 1] ?? 0), towards: inverse[i * 4 + 2] ?? 0 }))
    .sort((a, b) => a.towards - b.towards)
    .map(({ name, right, down }) => ({ name, right, down }));
}
