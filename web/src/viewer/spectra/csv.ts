/** Spectra as CSV: what is written, and references that are read. */

export interface Curve {
  name: string;
  mean: ArrayLike<number>;
  sd?: ArrayLike<number> | undefined;
}

/** A line for each band: wavelength, then each curve, and its standard deviation where it has one. */
export function writeCurves(wavelengths: readonly (number | null)[], curves: readonly Curve[]): string {
  const head = ["band", "wavelength_nm", ...curves.flatMap((c) => (c.sd ? [c.name, `${c.name} sd`] : [c.name]))];
  const rows = wavelengths.map((nm, b) => [
    String(b),
    nm === null ? "" : String(round(nm)),
    ...curves.flatMap((c) => (c.sd ? [cell(c.mean[b]), cell(c.sd[b])] : [cell(c.mean[b])])),
  ]);
  return [head.map(quoted), ...rows].map((row) => row.join(",")).join("\r\n") + "\r\n";
}

export interface Reference {
  name: string;
  nm: number[];
  values: number[];
}

/** What is wrong with a file that should hold a reference spectrum. */
export type ReferenceFault = "empty" | "columns" | "wavelengths";

/**
 * Read a spectrum: two columns of numbers, wavelength (nm, or µm below 100) and value, with comma, semicolon or
 * whitespace between; lines before the first numbers are a title. Reflectance
 * above 2 is taken for percentages.
 */
export function readReference(text: string, name: string, reflectance = true): Reference | ReferenceFault {
  const rows: [number, number][] = [];
  let textLines = 0;
  for (const line of text.replace(/^\uFEFF/, "").split(/\r\n|\r|\n/)) {
    if (line.trim() === "" || line.startsWith("#")) continue;
    const pair = numbersOf(line);
    if (pair) rows.push(pair);
    else if (rows.length > 0 || ++textLines > 50) return "columns";
  }
  if (rows.length === 0) return textLines > 0 ? "columns" : "empty";
  rows.sort((a, b) => a[0] - b[0]);
  const inMicrometres = rows.every(([nm]) => nm < 100);
  const nm = rows.map(([value]) => (inMicrometres ? round(value * 1000) : value));
  if (rows.length < 2 || nm.some((value, i) => value <= 0 || (i > 0 && value === nm[i - 1]))) return "wavelengths";
  const percent = reflectance && rows.some(([, value]) => value > 2) && rows.every(([, value]) => value <= 200);
  return { name, nm, values: rows.map(([, value]) => (percent ? value / 100 : value)) };
}

function numbersOf(line: string): [number, number] | null {
  // A decimal comma comes with semicolons or tabs between the columns.
  const parts = /[;\t]/.test(line)
    ? line.split(/[;\t]/).map((part) => part.trim().replace(",", "."))
    : line.trim().split(/\s*,\s*|\s+/);
  const [a, b] = parts.slice(0, 2).map((part) => (part === "" ? NaN : Number(part)));
  return a !== undefined && b !== undefined && Number.isFinite(a) && Number.isFinite(b) ? [a, b] : null;
}

function cell(value: number | undefined): string {
  return value === undefined || !Number.isFinite(value) ? "" : String(round(value));
}

function round(value: number): number {
  return Number(value.toPrecision(7));
}

/** A field of CSV; one that a spreadsheet would take for a formula begins with an apostrophe. */
export function quoted(text: string): string {
  const safe = /^[=+\-@\t]/.test(text) ? `'${text}` : text;
  return /[",\r\n]/.test(safe) ? `"${safe.replace(/"/g, '""')}"` : safe;
}
