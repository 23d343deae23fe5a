/** For each of some places the nearest point of a cloud. No DOM. */

/** Indices of the points nearest to places (n, 3), mm; -1 where none is within `most`. */
export function nearestPoints(xyz: Float32Array, places: Float32Array, most: number): Int32Array {
  const cell = most / 2;
  const size = 1 << 20;
  // Chains of points by the hash of their cell; others of the same hash are told apart by their distance.
  const heads = new Int32Array(size).fill(-1);
  const next = new Int32Array(xyz.length / 3);
  const hash = (i: number, j: number, k: number): number =>
    (Math.imul(i, 73856093) ^ Math.imul(j, 19349663) ^ Math.imul(k, 83492791)) & (size - 1);
  const cellOf = (value: number): number => Math.floor(value / cell);
  for (let p = 0; p < next.length; p++) {
    const at = hash(cellOf(xyz[p * 3] as number), cellOf(xyz[p * 3 + 1] as number), cellOf(xyz[p * 3 + 2] as number));
    next[p] = heads[at] as number;
    heads[at] = p;
  }
  const out = new Int32Array(places.length / 3).fill(-1);
  for (let n = 0; n < out.length; n++) {
    const x = places[n * 3] as number, y = places[n * 3 + 1] as number, z = places[n * 3 + 2] as number;
    const [ci, cj, ck] = [cellOf(x), cellOf(y), cellOf(z)];
    let least = most * most;
    // Rings of cells from the inside: once something is found, no farther ring can hold a nearer point.
    for (let ring = 0; ring <= 2; ring++) {
      for (let i = -ring; i <= ring; i++) {
        for (let j = -ring; j <= ring; j++) {
          for (let k = -ring; k <= ring; k++) {
            if (Math.max(Math.abs(i), Math.abs(j), Math.abs(k)) !== ring) continue;
            for (let p = heads[hash(ci + i, cj + j, ck + k)] as number; p >= 0; p = next[p] as number) {
              const square =
                ((xyz[p * 3] as number) - x) ** 2 + ((xyz[p * 3 + 1] as number) - y) ** 2 + ((xyz[p * 3 + 2] as number) - z) ** 2;
              if (square <= least) {
                least = square;
                out[n] = p;
              }
            }
          }
        }
      }
      if ((out[n] as number) >= 0 && least <= (ring * cell) ** 2) break;
    }
  }
  return out;
}
