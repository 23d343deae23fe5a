/** Numbers about spectra. */

/** Mean and standard deviation of each band over rows (n, bands), leaving out what is no number. */
export function meanAndDeviation(rows: Float32Array, bands: number): { mean: Float64Array; sd: Float64Array; n: number } {
  const n = Math.floor(rows.length / bands);
  const mean = new Float64Array(bands), sd = new Float64Array(bands), counts = new Float64Array(bands);
  for (let i = 0, at = 0; i < n; i++) {
    for (let b = 0; b < bands; b++, at++) {
      const value = rows[at] as number;
      if (value !== value) continue;
      // Welford's update: no loss of digits where the spread is small.
      const count = (counts[b] as number) + 1;
      counts[b] = count;
      const off = value - (mean[b] as number);
      mean[b] = (mean[b] as number) + off / count;
      sd[b] = (sd[b] as number) + off * (value - (mean[b] as number));
    }
  }
  for (let b = 0; b < bands; b++) {
    const count = counts[b] as number;
    sd[b] = count > 1 ? Math.sqrt((sd[b] as number) / (count - 1)) : count === 1 ? 0 : NaN;
    if (count === 0) mean[b] = NaN;
  }
  return { mean, sd, n };
}

/** Angle between two spectra, rad, over the bands where both have a value and `used` says so. */
export function spectralAngle(a: ArrayLike<number>, b: ArrayLike<number>, used: (band: number) => boolean = () => true): number {
  let dot = 0, aa = 0, bb = 0;
  for (let i = 0; i < a.length; i++) {
    const x = a[i] as number, y = b[i] as number;
    if (!used(i) || x !== x || y !== y) continue;
    dot += x * y;
    aa += x * x;
    bb += y * y;
  }
  return aa > 0 && bb > 0 ? Math.acos(Math.min(1, Math.max(-1, dot / Math.sqrt(aa * bb)))) : Math.PI / 2;
}

/** A spectrum at other wavelengths, linearly; NaN beyond its ends. `nm` rises. */
export function resampled(nm: readonly number[], values: readonly number[], at: readonly (number | null)[]): Float64Array {
  return Float64Array.from(at, (want) => {
    if (want === null || nm.length === 0) return NaN;
    const right = nm.findIndex((value) => value >= want);
    if (right < 0) return NaN;
    if (nm[right] === want) return values[right] as number;
    if (right === 0) return NaN;
    const x0 = nm[right - 1] as number, x1 = nm[right] as number;
    const t = (want - x0) / (x1 - x0);
    return (values[right - 1] as number) * (1 - t) + (values[right] as number) * t;
  });
}
