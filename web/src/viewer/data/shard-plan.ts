/** Which parts of a cloud are read, and in what order they are drawn. */

export interface Span {
  start: number;
  stop: number;
}

/** The shards of an array, the middle ones first: the specimen lies in the middle of the cube's picture. */
export function shardsFromMiddle(points: number, shard: number): Span[] {
  const count = Math.ceil(points / shard);
  const middle = (count - 1) / 2;
  return Array.from({ length: count }, (_, i) => i)
    .sort((a, b) => Math.abs(a - middle) - Math.abs(b - middle) || a - b)
    .map((i) => ({ start: i * shard, stop: Math.min((i + 1) * shard, points) }));
}

/**
 * The order in which points are drawn, so that every first part of it covers the whole cloud evenly.
 *
 * Points are in the order of tiles, so each 2^k-th point is an even choice: first each 64th, then those between, and so
 * on to all.
 */
export function levelOrder(points: number, coarsest = 64): Uint32Array<ArrayBuffer> {
  const order = new Uint32Array(points);
  let at = 0;
  // The phase within a row of 16 is turned from one 64 to the next: else a coarse level would be stripes.
  const turned = (i: number, phase: number): number => i + ((phase + (i / coarsest) * 21) & (coarsest - 1));
  for (let step = coarsest; step >= 1; step /= 2) {
    for (let phase = step === coarsest ? 0 : step; phase < coarsest; phase += step === coarsest ? coarsest : 2 * step) {
      for (let i = 0; i < points; i += coarsest) {
        const index = turned(i, phase);
        if (index < points) order[at++] = index;
      }
    }
  }
  return order;
}

/** Consecutive runs of sorted chunk numbers, joined across gaps of at most `gap` chunks. */
export function chunkRuns(chunks: ArrayLike<number>, gap: number, longest = Infinity): Span[] {
  const runs: Span[] = [];
  for (let i = 0; i < chunks.length; i++) {
    const chunk = chunks[i] ?? 0;
    const last = runs.at(-1);
    if (last && chunk - last.stop <= gap && chunk + 1 - last.start <= longest) last.stop = chunk + 1;
    else runs.push({ start: chunk, stop: chunk + 1 });
  }
  return runs;
}
