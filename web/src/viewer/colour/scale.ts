/** From values to colours: percentiles, ranges, indices of two bands. */

export type Range = readonly [number, number];
/** Shown where a point has no value. */
export const NO_VALUE_RGB = [96, 96, 104] as const;

/** Values at percentiles (0 to 100) of those that are finite, from an even sample; [0, 1] where there is none. */
export function percentiles(values: ArrayLike<number>, low: number, high: number, most = 20000): Range {
  const step = Math.max(1, Math.floor(values.length / most));
  const sample: number[] = [];
  for (let i = 0; i < values.length; i += step) {
    const value = values[i];
    if (value !== undefined && Number.isFinite(value)) sample.push(value);
  }
  if (sample.length === 0) return [0, 1];
  sample.sort((a, b) => a - b);
  const at = (p: number): number => sample[Math.round((p / 100) * (sample.length - 1))] ?? 0;
  const range: Range = [at(low), at(high)];
  return range[1] > range[0] ? range : [range[0], range[0] + 1e-6];
}

/** Write colours (four bytes a point, of which the last stays) of values on a colour table. */
export function paintScalar(values: Float32Array, [low, high]: Range, table: Uint8Array, into: Uint8Array): void {
  const factor = 255.999 / (high - low);
  for (let i = 0, at = 0; i < values.length; i++, at += 4) {
    const value = values[i] as number;
    if (value !== value) {
      into[at] = NO_VALUE_RGB[0];
      into[at + 1] = NO_VALUE_RGB[1];
      into[at + 2] = NO_VALUE_RGB[2];
      continue;
    }
    const place = (value - low) * factor;
    const entry = (place < 0 ? 0 : place > 255 ? 255 : place | 0) * 3;
    into[at] = table[entry] as number;
    into[at + 1] = table[entry + 1] as number;
    into[at + 2] = table[entry + 2] as number;
  }
}

/** Write one channel (0 red, 1 green, 2 blue) of values between the ends of a range. */
export function paintChannel(values: Float32Array, [low, high]: Range, channel: 0 | 1 | 2, into: Uint8Array): void {
  const factor = 255.999 / (high - low);
  for (let i = 0, at: number = channel; i < values.length; i++, at += 4) {
    const place = ((values[i] as number) - low) * factor;
    into[at] = place > 0 ? (place > 255 ? 255 : place | 0) : 0;
  }
}

/** a / b; NaN where b is not positive. */
export function ratio(a: Float32Array, b: Float32Array): Float32Array<ArrayBuffer> {
  const out = new Float32Array(a.length);
  for (let i = 0; i < a.length; i++) {
    const divisor = b[i] as number;
    out[i] = divisor > 0 ? (a[i] as number) / divisor : NaN;
  }
  return out;
}

/** (a - b) / (a + b); NaN where a + b is not positive, as the service's index previews. */
export function normalisedDifference(a: Float32Array, b: Float32Array): Float32Array<ArrayBuffer> {
  const out = new Float32Array(a.length);
  for (let i = 0; i < a.length; i++) {
    const x = a[i] as number, y = b[i] as number;
    out[i] = x + y > 0 ? (x - y) / (x + y) : NaN;
  }
  return out;
}

/** Lay class colours over colours. `colours` has three bytes and an alpha (0 or 255) for each class value. */
export function paintClasses(values: ArrayLike<number>, colours: Uint8Array, opacity: number, into: Uint8Array): void {
  const weight = Math.round(opacity * 256);
  for (let i = 0, at = 0; i < values.length; i++, at += 4) {
    const entry = (values[i] as number) * 4;
    if (!colours[entry + 3]) continue;
    for (let c = 0; c < 3; c++) {
      const below = into[at + c] as number;
      into[at + c] = below + ((((colours[entry + c] as number) - below) * weight) >> 8);
    }
  }
}

/** A few round numbers between the ends of a range, for a colour bar. */
export function ticks([low, high]: Range, most = 5): number[] {
  const raw = (high - low) / Math.max(1, most);
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= raw) ?? raw;
  const found: number[] = [];
  for (let n = Math.ceil(low / step - 1e-9); n * step <= high + step * 1e-9; n++) found.push(Number((n * step).toPrecision(12)));
  return found;
}
