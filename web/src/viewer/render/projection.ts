/** Where points lie on the screen, and which point lies under a place on it. No DOM, no GPU. */
import type { Matrix4Tuple } from "three";
import type { PointCloud } from "../data/point-cloud";

/** What is needed of a camera: clip = matrix * place (column-major, as in three.js), and the size in CSS pixels. */
export interface Projection {
  matrix: Matrix4Tuple;
  width: number;
  height: number;
}

/** Half-space that is shown: a x + b y + c z + d >= 0. */
export type Plane = readonly [number, number, number, number];

/** Column, row in CSS pixels and distance along the view; null behind the camera. */
export function project(p: Projection, x: number, y: number, z: number): { x: number; y: number; depth: number } | null {
  const m = p.matrix;
  const w = m[3] * x + m[7] * y + m[11] * z + m[15];
  if (w <= 1e-6) return null;
  return {
    x: ((m[0] * x + m[4] * y + m[8] * z + m[12]) / w + 1) * 0.5 * p.width,
    y: (1 - (m[1] * x + m[5] * y + m[9] * z + m[13]) / w) * 0.5 * p.height,
    depth: w,
  };
}

/** Pixels that a length of 1 mm has at depth 1. */
export function pixelsPerMm(p: Projection): number {
  const m = p.matrix;
  return 0.5 * p.height * Math.hypot(m[1], m[5], m[9]);
}

/** Points so little behind the nearest one belong to the same surface, mm. */
const SURFACE_MM = 1;

/**
 * The point under a place on the screen: of those within `radius` pixels the surface nearest to the camera, where a
 * pixel aside counts as three times the length it covers; of that surface the point nearest to the place.
 * null where there is none.
 */
export function pick(cloud: PointCloud, p: Projection, x: number, y: number, radius: number, plane: Plane | null): number | null {
  const { xyz } = cloud;
  const perMm = pixelsPerMm(p);
  const found: { index: number; depth: number; aside: number; score: number }[] = [];
  cloud.forChunks(mayShow(cloud, p, { x0: x - radius, y0: y - radius, x1: x + radius, y1: y + radius }), (start, stop) => {
    for (let i = start; i < stop; i++) {
      const px = xyz[i * 3] as number, py = xyz[i * 3 + 1] as number, pz = xyz[i * 3 + 2] as number;
      if (plane && plane[0] * px + plane[1] * py + plane[2] * pz + plane[3] < 0) continue;
      const at = project(p, px, py, pz);
      if (!at) continue;
      const aside = Math.hypot(at.x - x, at.y - y);
      if (aside <= radius) found.push({ index: i, depth: at.depth, aside, score: at.depth + (3 * aside * at.depth) / perMm });
    }
  });
  const front = found.reduce((least, { score }) => Math.min(least, score), Infinity);
  let best: (typeof found)[number] | null = null;
  for (const one of found) if (one.depth <= front + SURFACE_MM && (!best || one.aside < best.aside)) best = one;
  return best?.index ?? null;
}

export interface ScreenBox {
  x0: number;
  y0: number;
  x1: number;
  y1: number;
}

/** A test whether a chunk's box may reach into a box on the screen. */
export function mayShow(cloud: PointCloud, p: Projection, box: ScreenBox): (at: number) => boolean {
  const b = cloud.boxes;
  const perMm = pixelsPerMm(p);
  return (at) => {
    const dx = (b[at + 3] as number) - (b[at] as number), dy = (b[at + 4] as number) - (b[at + 1] as number), dz = (b[at + 5] as number) - (b[at + 2] as number);
    const half = Math.hypot(dx, dy, dz) / 2;
    const centre = project(p, (b[at] as number) + dx / 2, (b[at + 1] as number) + dy / 2, (b[at + 2] as number) + dz / 2);
    if (!centre || centre.depth <= half) return true;
    const reach = (half * perMm) / (centre.depth - half) + 1;
    return centre.x + reach >= box.x0 && centre.x - reach <= box.x1 && centre.y + reach >= box.y0 && centre.y - reach <= box.y1;
  };
}
