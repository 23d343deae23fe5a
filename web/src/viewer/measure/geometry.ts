/** Lengths, angles and areas between places, mm. No DOM. */

export type Place = readonly [number, number, number];

export function distance(a: Place, b: Place): number {
  return Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
}

/** Length of a line through places. */
export function lengthOf(line: readonly Place[]): number {
  return line.slice(1).reduce((sum, place, i) => sum + distance(line[i] ?? place, place), 0);
}

/** Angle at the middle one of three places, degrees. */
export function angleAt(a: Place, middle: Place, b: Place): number {
  const u = minus(a, middle), v = minus(b, middle);
  const norm = Math.hypot(...u) * Math.hypot(...v);
  return norm === 0 ? NaN : (Math.acos(Math.min(1, Math.max(-1, dot(u, v) / norm))) * 180) / Math.PI;
}

/** Area of a closed outline in space: that of its projection along its mean normal (Newell). */
export function outlineArea(outline: readonly Place[]): number {
  let sum: Place = [0, 0, 0];
  outline.forEach((a, i) => {
    const b = outline[(i + 1) % outline.length] ?? a;
    sum = plus(sum, cross(a, b));
  });
  return Math.hypot(...sum) / 2;
}

/** Length, and its standard deviation from those of the places' positions, taken as independent. */
export function deviationOfLength(line: readonly Place[], sigmas: readonly number[]): number {
  // The derivative of the length after each place is the sum of the unit vectors of the two pieces that meet there.
  let variance = 0;
  line.forEach((place, i) => {
    let pull: Place = [0, 0, 0];
    for (const other of [line[i - 1], line[i + 1]]) {
      const apart = other ? distance(other, place) : 0;
      if (other && apart > 0) pull = plus(pull, scaled(minus(place, other), 1 / apart));
    }
    variance += dot(pull, pull) * (sigmas[i] ?? 0) ** 2;
  });
  return Math.sqrt(variance);
}

export function minus(a: Place, b: Place): Place {
  return [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
}

export function plus(a: Place, b: Place): Place {
  return [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
}

export function scaled(a: Place, factor: number): Place {
  return [a[0] * factor, a[1] * factor, a[2] * factor];
}

export function dot(a: Place, b: Place): number {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

export function cross(a: Place, b: Place): Place {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}
