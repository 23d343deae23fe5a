/** An even sample of spectra stands for all points until their own values have come. No DOM. */

/** Values of a sample that are read at most: 48 MB. */
const MOST_VALUES = 12_000_000;
/** Points of one page of the service. */
const MOST_POINTS = 100_000;

export interface Sample {
  /** Each `step`-th point is in the sample. */
  step: number;
  count: number;
  /** Spectra, (count, bands). */
  spectra: Float32Array;
}

/** Choose the step of an even sample: consecutive points are neighbours, so 16 of them are a row of a tile. */
export function sampleStep(points: number, bands: number): number {
  let step = 16;
  while ((points / step) * bands > MOST_VALUES || points / step > MOST_POINTS) step *= 2;
  return step;
}

/** A band of all points, each with the value of its neighbour in the sample. */
export function bandOfSample(sample: Sample, band: number, bands: number, points: number): Float32Array<ArrayBuffer> {
  const out = new Float32Array(points);
  for (let i = 0; i < sample.count; i++) {
    const start = i * sample.step;
    out.fill(sample.spectra[i * bands + band] ?? NaN, start, Math.min(start + sample.step, points));
  }
  return out;
}
