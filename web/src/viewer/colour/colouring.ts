/** Colours of all points as a state of the view asks for them: what is there at once, then what has been waited for. */
import { signal } from "@preact/signals";
import { fetched } from "../../api/client";
import { asProblem, type Problem } from "../../api/problem";
import type { BandSource } from "../data/band-source";
import type { CloudLoader } from "../data/cloud-loader";
import type { PointCloud } from "../data/point-cloud";
import type { ViewState } from "../view-state";
import { colourTable } from "./colour-maps";
import { flagColours } from "./flags";
import { normalisedDifference, paintChannel, paintScalar, percentiles, ratio, type Range } from "./scale";

/** What the colour bar shows. */
export interface Scale {
  range: Range;
  /** From the least to the largest value, for the handles. */
  limits: Range;
  /** Whether each point has its own value, or that of its neighbour until it has come. */
  exact: boolean;
}

export interface Sources {
  cloud: PointCloud;
  cloudId: string;
  loader: CloudLoader;
  bands: BandSource;
  cubeShape: readonly number[];
}

const MODES_WITH_SCALE = new Set(["band", "ratio", "difference", "height", "sigma"]);
const LOW = 2, HIGH = 98;

export function hasScale(mode: string): boolean {
  return MODES_WITH_SCALE.has(mode);
}

export class Colouring {
  readonly scale = signal<Scale | null>(null);
  readonly busy = signal(false);
  readonly problem = signal<Problem | null>(null);
  /** Values of the points in the modes that have a scale. */
  values: Float32Array | null = null;
  private round = 0;
  private heights: Float32Array | null = null;
  private limits: { of: Float32Array; range: Range; limits: Range } | null = null;

  constructor(private readonly sources: Sources) {}

  /** Write the colours of a state, perhaps twice: `written` is called each time. */
  async paint(state: ViewState, into: Uint8Array, written: () => void): Promise<void> {
    const round = ++this.round;
    const current = (): boolean => round === this.round;
    this.problem.value = null;
    this.busy.value = true;
    try {
      await this.paintMode(state, into, () => current() && written(), current);
    } catch (thrown) {
      if (current()) this.problem.value = asProblem(thrown);
    } finally {
      if (current()) this.busy.value = false;
    }
  }

  private async paintMode(state: ViewState, into: Uint8Array, written: () => void, current: () => boolean): Promise<void> {
    const { cloud, loader } = this.sources;
    if (!hasScale(state.mode)) {
      this.scale.value = null;
      this.values = null;
    }
    switch (state.mode) {
      case "photo":
        copyColours(cloud.rgb, into);
        written();
        return;
      case "band":
        return this.inTwoSteps([state.band], current, ([values], exact) => this.paintValues(values, state, exact, into, written));
      case "ratio":
      case "difference": {
        const combine = state.mode === "ratio" ? ratio : normalisedDifference;
        return this.inTwoSteps(state.pair, current, ([a, b], exact) => {
          if (a && b) this.paintValues(combine(a, b), state, exact, into, written);
        });
      }
      case "composite":
        return this.inTwoSteps(state.bands, current, (found) => {
          found.forEach((values, i) => paintChannel(values, percentiles(values, LOW, HIGH), i as 0 | 1 | 2, into));
          written();
        });
      case "height":
        if (!this.heights || !cloud.complete) this.heights = heightsOf(cloud);
        this.paintValues(this.heights, state, true, into, written);
        return;
      case "sigma": {
        const values = (await loader.array("sigma_mm", 1)) as Float32Array;
        if (current()) this.paintValues(values, state, true, into, written);
        return;
      }
      case "flags": {
        const flags = (await loader.array("flags", 1)) as Uint8Array;
        if (!current()) return;
        flagColours(flags, into);
        written();
        return;
      }
      case "pca": {
        const [pixels, picture] = await Promise.all([loader.array("hsi_pixel", 2), this.componentPicture()]);
        if (!current()) return;
        fromPicture(pixels as Uint16Array, picture, into);
        written();
        return;
      }
    }
  }

  /** Paint with the sample of spectra at once, and again with the bands themselves when they have come. */
  private async inTwoSteps(
    bands: readonly number[],
    current: () => boolean,
    show: (values: Float32Array[], exact: boolean) => void,
  ): Promise<void> {
    const source = this.sources.bands;
    const found = bands.map((band) => source.now(band));
    const exact = found.every((band) => band?.exact);
    if (found.every((band) => band !== null)) show(found.map((band) => band.values), exact);
    else {
      // The first time there is no sample yet: whichever comes first is shown.
      void source.sample().then(() => {
        const later = bands.map((band) => source.now(band));
        if (current() && later.every((band) => band !== null) && this.waitsFor(bands)) show(later.map((b) => b.values), false);
      }, () => undefined);
    }
    if (exact) return;
    const values = await Promise.all(bands.map((band) => source.exact(band)));
    if (current()) show(values, true);
  }

  private waitsFor(bands: readonly number[]): boolean {
    return bands.some((band) => this.sources.bands.now(band)?.exact !== true);
  }

  private paintValues(values: Float32Array | undefined, state: ViewState, exact: boolean, into: Uint8Array, written: () => void): void {
    if (!values) return;
    this.values = values;
    if (this.limits?.of !== values) {
      this.limits = { of: values, range: percentiles(values, LOW, HIGH), limits: percentiles(values, 0, 100) };
    }
    const range = state.range ?? this.limits.range;
    paintScalar(values, range, colourTable(state.map), into);
    this.scale.value = { range, limits: this.limits.limits, exact };
    written();
  }

  private picture: Promise<ImageData> | null = null;

  /** The principal components as the run drew them, a pixel of the cube a pixel. */
  private componentPicture(): Promise<ImageData> {
    const { cloudId, cubeShape } = this.sources;
    const size = Math.max(cubeShape[0] ?? 1024, cubeShape[1] ?? 1024);
    this.picture ??= fetched(`/v1/clouds/${cloudId}/previews/pca.png?grid=cube&size=${Math.min(size, 4096)}`)
      .then((answer) => answer.blob())
      .then(pixelsOf);
    this.picture.catch(() => (this.picture = null));
    return this.picture;
  }
}

function copyColours(rgb: Uint8Array, into: Uint8Array): void {
  for (let from = 0, to = 0; from < rgb.length; from += 3, to += 4) {
    into[to] = rgb[from] as number;
    into[to + 1] = rgb[from + 1] as number;
    into[to + 2] = rgb[from + 2] as number;
  }
}

function heightsOf(cloud: PointCloud): Float32Array {
  const out = new Float32Array(cloud.points);
  for (let i = 0; i < out.length; i++) {
    const z = cloud.xyz[i * 3 + 2] as number;
    out[i] = z > 1e8 ? NaN : z;
  }
  return out;
}

async function pixelsOf(picture: Blob): Promise<ImageData> {
  const image = await createImageBitmap(picture);
  const canvas = new OffscreenCanvas(image.width, image.height);
  const context = canvas.getContext("2d", { willReadFrequently: true });
  if (!context) throw new Error("no canvas");
  context.drawImage(image, 0, 0);
  return context.getImageData(0, 0, image.width, image.height);
}

function fromPicture(pixels: Uint16Array, { data, width, height }: ImageData, into: Uint8Array): void {
  for (let i = 0, to = 0; to < into.length; i += 2, to += 4) {
    const row = pixels[i] as number, column = pixels[i + 1] as number;
    if (row >= height || column >= width) continue;
    const from = (row * width + column) * 4;
    into[to] = data[from] as number;
    into[to + 1] = data[from + 1] as number;
    into[to + 2] = data[from + 2] as number;
  }
}
