/** Which picked files make a cube: a file of its own, or an ENVI header and its data. Nothing here reads a file. */
import type { Role } from "../uploads/item";

export type CubeRole = Exclude<Role, "photo">;

export interface Picked {
  readonly name: string;
  readonly size: number;
}

export interface Part<F extends Picked> {
  readonly file: F;
  readonly role: CubeRole;
  readonly part: "header" | "data" | "whole";
}

export interface Pairing<F extends Picked> {
  /** To be sent, headers before their data. */
  readonly parts: readonly Part<F>[];
  /** No cube's: photos, text, archives. */
  readonly foreign: readonly F[];
  /** Roles that more than one cube was picked for. */
  readonly crowded: readonly CubeRole[];
  /** Roles of which only one part was picked, by the part that is missing. */
  readonly lacking: Partial<Record<CubeRole, "header" | "data">>;
}

const WHOLE = new Set(["npy", "npz", "h5", "hdf5", "he5", "nc", "nc4", "cdf", "mat", "tif", "tiff"]);
const DATA = new Set(["", "raw", "dat", "img", "bil", "bip", "bsq", "bin", "cube", "hsi", "hdf", "btf"]);
const REFERENCE: readonly [CubeRole, RegExp][] = [
  ["white", /(^|[^a-z])white(ref|reference)?([^a-z]|$)/i],
  ["dark", /(^|[^a-z])dark(ref|reference|current)?([^a-z]|$)/i],
];

/** The end of a name, lower case, without its dot. */
export function suffixOf(name: string): string {
  const dot = name.lastIndexOf(".");
  return dot > 0 ? name.slice(dot + 1).toLowerCase() : "";
}

/** The role that a name tells, as WHITEREF_scan.hdr does. */
export function roleOf(name: string): CubeRole {
  return REFERENCE.find(([, words]) => words.test(name))?.[0] ?? "cube";
}

/** The name that header and data share: scan.hdr, scan.raw.hdr, scan.raw and scan are of one cube. */
export function stemOf(name: string): string {
  const cut = (text: string, ends: ReadonlySet<string>): string => {
    const suffix = suffixOf(text);
    return suffix && ends.has(suffix) ? text.slice(0, -suffix.length - 1) : text;
  };
  return cut(cut(name, new Set(["hdr"])), DATA).toLowerCase();
}

/** Find the cubes among picked files. `role` where the person said it; else names tell it. */
export function pairedUp<F extends Picked>(files: readonly F[], role?: CubeRole): Pairing<F> {
  const parts: Part<F>[] = [];
  const foreign: F[] = [];
  for (const file of files) {
    const suffix = suffixOf(file.name);
    const part = suffix === "hdr" ? "header" : WHOLE.has(suffix) ? "whole" : DATA.has(suffix) ? "data" : null;
    if (part === null) foreign.push(file);
    else parts.push({ file, part, role: role ?? roleOf(file.name) });
  }
  const headers = new Set(parts.filter(({ part }) => part === "header").map(({ file }) => stemOf(file.name)));
  // Beside one header a folder may hold files that are not its data, such as a picture of the scan.
  const own = parts.filter(({ part, file }) => part !== "data" || headers.size === 0 || headers.has(stemOf(file.name)));
  const orphans = parts.filter((part) => !own.includes(part));
  const used = headers.size === 1 && !own.some(({ part }) => part === "data") ? parts : own;
  if (used === own) foreign.push(...orphans.map(({ file }) => file));
  const crowded: CubeRole[] = [];
  const lacking: Partial<Record<CubeRole, "header" | "data">> = {};
  for (const each of new Set(used.map((part) => part.role))) {
    const count = (what: Part<F>["part"]): number => used.filter((one) => one.role === each && one.part === what).length;
    const [h, d, w] = [count("header"), count("data"), count("whole")];
    if (w + Math.max(h, d) > 1) crowded.push(each);
    else if (w === 0 && h !== d) lacking[each] = h ? "data" : "header";
  }
  const rank = { header: 0, whole: 1, data: 2 };
  return { parts: [...used].sort((a, b) => rank[a.part] - rank[b.part]), foreign, crowded, lacking };
}

const BYTES_OF: Record<string, number> = { 1: 1, 2: 2, 3: 4, 4: 4, 5: 8, 6: 8, 9: 16, 12: 2, 13: 4, 14: 8, 15: 8 };

/** How many bytes of data an ENVI header's text announces; null where it does not say. */
export function announcedBytes(header: string): number | null {
  const value = (field: string): number | null => {
    const found = new RegExp(`^\\s*${field}\\s*=\\s*(\\d+)\\s*$`, "im").exec(header);
    return found?.[1] === undefined ? null : Number(found[1]);
  };
  const [samples, lines, bands, type] = ["samples", "lines", "bands", "data type"].map(value);
  const size = type == null ? undefined : BYTES_OF[type];
  if (samples == null || lines == null || bands == null || size === undefined) return null;
  return samples * lines * bands * size + (value("header offset") ?? 0);
}
