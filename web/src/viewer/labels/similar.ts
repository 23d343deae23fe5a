/** Points whose spectra are like that of a point. */
import type { CloudLoader } from "../data/cloud-loader";
import { CHUNK } from "../data/point-cloud";
import { chunkRuns } from "../data/shard-plan";
import { spectralAngle } from "../spectra/statistics";

export interface Wanted {
  /** Spectrum to be like. */
  spectrum: ArrayLike<number>;
  /** Largest angle, rad. */
  most: number;
  usedBands: readonly boolean[];
}

/** Chunks that are read together: 4096 points. */
const CHUNKS_TOGETHER = 16;

/** Which of some rows (n, bands) of stored spectra are like the one that is wanted. */
export function likeRows(
  rows: Uint16Array,
  bands: number,
  decode: { scale: number; offset: number; fill: number | null },
  { spectrum, most, usedBands }: Wanted,
): number[] {
  const found: number[] = [];
  const row = new Float64Array(bands);
  for (let i = 0; i * bands < rows.length; i++) {
    for (let b = 0; b < bands; b++) {
      const stored = rows[i * bands + b] as number;
      row[b] = stored === decode.fill ? NaN : stored * decode.scale + decode.offset;
    }
    if (spectralAngle(row, spectrum, (band) => usedBands[band] === true) <= most) found.push(i);
  }
  return found;
}

/** The points among `candidates` (increasing) whose stored spectra are like the wanted one; read as they are needed. */
export async function similarPoints(
  loader: CloudLoader,
  bands: number,
  points: number,
  candidates: readonly number[],
  wanted: Wanted,
  signal: AbortSignal,
): Promise<number[]> {
  const inside = new Set(candidates);
  const chunks = [...new Set(candidates.map((index) => Math.floor(index / CHUNK)))];
  const spans = chunkRuns(chunks, 0, CHUNKS_TOGETHER).map(({ start, stop }) => ({
    start: start * CHUNK,
    stop: Math.min(stop * CHUNK, points),
  }));
  const found: number[] = [];
  await loader.spectra(
    spans,
    (start, rows) => {
      for (const i of likeRows(rows, bands, loader.decode, wanted)) if (inside.has(start + i)) found.push(start + i);
    },
    signal,
  );
  return found.sort((a, b) => a - b);
}
