/** Which points lie within an outline drawn on the screen, and are seen there. No DOM. */
import type { PointCloud } from "../data/point-cloud";
import { mayShow, pixelsPerMm, project, type Plane, type Projection } from "../render/projection";

export type Outline = readonly (readonly [number, number])[];

/** Whether a place lies within a closed outline: even-odd rule. */
export function inOutline(outline: Outline, x: number, y: number): boolean {
  let inside = false;
  for (let i = 0, j = outline.length - 1; i < outline.length; j = i++) {
    const [xi, yi] = outline[i] ?? [0, 0], [xj, yj] = outline[j] ?? [0, 0];
    if (yi > y !== yj > y && x < ((xj - xi) * (y - yi)) / (yj - yi) + xi) inside = !inside;
  }
  return inside;
}

/** Points of an outline that the hand did not need: those less than `step` pixels from the last are left out. */
export function thinned(outline: Outline, step = 2): Outline {
  const kept: (readonly [number, number])[] = [];
  for (const at of outline) {
    const last = kept.at(-1);
    if (!last || Math.hypot(at[0] - last[0], at[1] - last[1]) >= step) kept.push(at);
  }
  return kept;
}

const CELL_PX = 4;

/**
 * The points within an outline that nothing hides: in each cell of 4 pixels, those at most `thick` mm behind the nearest.
 */
export function pointsInOutline(cloud: PointCloud, p: Projection, outline: Outline, plane: Plane | null, thick = 1): number[] {
  if (outline.length < 3) return [];
  const xs = outline.map(([x]) => x), ys = outline.map(([, y]) => y);
  const box = { x0: Math.min(...xs), y0: Math.min(...ys), x1: Math.max(...xs), y1: Math.max(...ys) };
  const columns = Math.ceil((box.x1 - box.x0) / CELL_PX) + 1;
  const rows = Math.ceil((box.y1 - box.y0) / CELL_PX) + 1;
  const nearest = new Float32Array(columns * rows).fill(Infinity);
  const cellOf = (x: number, y: number): number =>
    Math.floor((y - box.y0) / CELL_PX) * columns + Math.floor((x - box.x0) / CELL_PX);
  const found: { index: number; cell: number; depth: number }[] = [];
  cloud.forChunks(mayShow(cloud, p, box), (start, stop) => {
    for (let i = start; i < stop; i++) {
      const [x, y, z] = cloud.place(i);
      if (plane && plane[0] * x + plane[1] * y + plane[2] * z + plane[3] < 0) continue;
      const at = project(p, x, y, z);
      if (!at || at.x < box.x0 || at.x > box.x1 || at.y < box.y0 || at.y > box.y1) continue;
      const cell = cellOf(at.x, at.y);
      nearest[cell] = Math.min(nearest[cell] ?? Infinity, at.depth);
      if (inOutline(outline, at.x, at.y)) found.push({ index: i, cell, depth: at.depth });
    }
  });
  // A cell's own slant counts too: seen flat, a surface runs far back within four pixels.
  const slant = (depth: number): number => thick + (3 * CELL_PX * depth) / pixelsPerMm(p);
  return found
    .filter(({ cell, depth }) => depth <= (nearest[cell] ?? 0) + slant(nearest[cell] ?? 0))
    .map(({ index }) => index)
    .sort((a, b) => a - b);
}
