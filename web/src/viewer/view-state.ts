/** What a link to a view holds: camera, colouring, section, layer, chosen points. Read and written without a DOM. */
import { isColourMap, type ColourMapName } from "./colour/colour-maps";
import type { Range } from "./colour/scale";

export const MODES = ["photo", "band", "composite", "pca", "ratio", "difference", "height", "sigma", "flags"] as const;
export type Mode = (typeof MODES)[number];
export const SHAPES = ["cloud", "mesh", "both"] as const;
export type Shape = (typeof SHAPES)[number];
export type Axis = "x" | "y" | "z";

export interface Section {
  axis: Axis;
  /** mm along the axis. */
  at: number;
  /** Show the upper side instead of the lower. */
  flip: boolean;
}

export interface ViewState {
  camera: readonly [number, number, number, number, number, number] | null;
  mode: Mode;
  band: number;
  bands: readonly [number, number, number];
  /** The two bands of ratio and difference. */
  pair: readonly [number, number];
  map: ColourMapName;
  /** Values at the ends of the colour bar; null: the 2nd and 98th percentile. */
  range: Range | null;
  layer: string | null;
  opacity: number;
  section: Section | null;
  shape: Shape;
  /** Size of points over the distance of neighbours. */
  size: number;
  /** Points whose spectra are shown. */
  chosen: readonly number[];
}

export const MOST_CHOSEN = 8;
/** Of a number in a link: beyond any value of a cube, and far from where arithmetic overflows. */
const LARGEST = 1e15;
/** mm: from a camera nearer to what it looks at, or farther from the markers, nothing is seen. */
const NEAREST = 0.01, FARTHEST = 1e6;

/** The state in which a cloud of so many bands opens. */
export function firstState(wavelengths: readonly (number | null)[]): ViewState {
  const near = (nm: number): number => nearestBand(wavelengths, nm);
  return {
    camera: null,
    mode: "photo",
    band: near(640),
    bands: [near(640), near(550), near(460)],
    pair: [near(800), near(600)],
    map: "viridis",
    range: null,
    layer: null,
    opacity: 0.6,
    section: null,
    shape: "cloud",
    size: 1,
    chosen: [],
  };
}

/** The band nearest to a wavelength; where wavelengths are unknown, one so far along as 400 to 1000 nm would have it. */
export function nearestBand(wavelengths: readonly (number | null)[], nm: number): number {
  let best = Math.round(Math.min(1, Math.max(0, (nm - 400) / 600)) * Math.max(0, wavelengths.length - 1));
  let least = Infinity;
  wavelengths.forEach((value, i) => {
    if (value !== null && Math.abs(value - nm) < least) {
      least = Math.abs(value - nm);
      best = i;
    }
  });
  return best;
}

/** Write what differs from the first state. */
export function encode(state: ViewState, first: ViewState): URLSearchParams {
  const out = new URLSearchParams();
  const put = <K extends keyof ViewState>(name: string, key: K, write: (value: NonNullable<ViewState[K]>) => string): void => {
    const value = state[key];
    if (value !== null && JSON.stringify(value) !== JSON.stringify(first[key])) out.set(name, write(value));
  };
  const list = (values: readonly number[]): string => values.map(short).join(",");
  put("camera", "camera", list);
  put("mode", "mode", String);
  put("band", "band", String);
  put("rgb", "bands", list);
  put("pair", "pair", list);
  put("map", "map", String);
  put("range", "range", list);
  put("layer", "layer", String);
  put("opacity", "opacity", short);
  put("section", "section", ({ axis, at, flip }) => [axis, short(at), flip ? "upper" : "lower"].join(","));
  put("shape", "shape", String);
  put("size", "size", short);
  put("points", "chosen", list);
  return out;
}

/** Read a link's state. Whatever does not fit the cloud is as in the first state. */
export function decode(query: URLSearchParams, first: ViewState, points: number, bandCount: number): ViewState {
  const text = (name: string): string | null => query.get(name);
  const numbers = (name: string, count?: number): number[] | null => {
    const found = text(name)?.split(",").map((part) => (part.trim() === "" ? NaN : Number(part)));
    return found?.every((value) => Math.abs(value) <= LARGEST) && (count === undefined || found.length === count) ? found : null;
  };
  const isBand = (value: number): boolean => Number.isInteger(value) && value >= 0 && value < bandCount;
  const bandsOf = (name: string, count: number): number[] | null => {
    const found = numbers(name, count);
    return found?.every(isBand) ? found : null;
  };
  const between = (name: string, low: number, high: number, otherwise: number): number => {
    const value = numbers(name, 1)?.[0];
    return value === undefined || value < low || value > high ? otherwise : value;
  };
  const range = numbers("range", 2) as [number, number] | null;
  const map = text("map");
  return {
    camera: cameraOf(numbers("camera", 6)) ?? first.camera,
    mode: MODES.find((mode) => mode === text("mode")) ?? first.mode,
    band: bandsOf("band", 1)?.[0] ?? first.band,
    bands: (bandsOf("rgb", 3) as [number, number, number] | null) ?? first.bands,
    pair: (bandsOf("pair", 2) as [number, number] | null) ?? first.pair,
    map: isColourMap(map) ? map : first.map,
    range: range && range[0] < range[1] ? range : null,
    layer: /^[a-z0-9_-]{1,64}$/.test(text("layer") ?? "") ? text("layer") : null,
    opacity: between("opacity", 0, 1, first.opacity),
    section: sectionOf(text("section")),
    shape: SHAPES.find((shape) => shape === text("shape")) ?? first.shape,
    size: between("size", 0.25, 4, first.size),
    chosen: [...new Set(numbers("points") ?? [])].filter((i) => Number.isInteger(i) && i >= 0 && i < points).slice(0, MOST_CHOSEN),
  };
}

function cameraOf(found: number[] | null): ViewState["camera"] {
  if (!found || found.some((value) => Math.abs(value) > FARTHEST)) return null;
  const [x = 0, y = 0, z = 0, a = 0, b = 0, c = 0] = found;
  return Math.hypot(x - a, y - b, z - c) < NEAREST ? null : [x, y, z, a, b, c];
}

function sectionOf(text: string | null): Section | null {
  const found = /^([xyz]),(-?\d+(?:\.\d+)?),(upper|lower)$/.exec(text ?? "");
  const at = Number(found?.[2]);
  return found && Math.abs(at) <= FARTHEST ? { axis: found[1] as Axis, at, flip: found[3] === "upper" } : null;
}

/** Three digits after the point: micrometres. Ranges of small reflectances keep more. */
function short(value: number): string {
  return String(Math.abs(value) >= 1 ? Math.round(value * 1000) / 1000 : Number(value.toPrecision(4)));
}
