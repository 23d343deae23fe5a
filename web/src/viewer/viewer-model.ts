/** What the parts of the viewer share: the cloud, the state of the view, and what follows from it. */
import { effect, signal, untracked } from "@preact/signals";
import type { Schemas } from "../api/client";
import { asProblem, type Problem } from "../api/problem";
import { setQuery } from "../app/route";
import { Colouring } from "./colour/colouring";
import { rgbOf } from "./colour/colour-maps";
import { paintClasses } from "./colour/scale";
import { BandSource } from "./data/band-source";
import { CloudLoader } from "./data/cloud-loader";
import type { PointCloud } from "./data/point-cloud";
import { LayerModel } from "./labels/layer-model";
import type { CloudView } from "./render/cloud-view";
import type { MeshView } from "./render/mesh-view";
import { pick, type Plane } from "./render/projection";
import { SpectraStore } from "./spectra/spectra-store";
import { t } from "./texts";
import { decode, encode, firstState, type Section, type Shape, type ViewState } from "./view-state";

export type CloudInfo = Schemas["Cloud"];
/** What a tap or a stroke on the picture does. A part of the page that is loaded later brings its own. */
export interface Tool {
  name: string;
  /** Take the pointer's place on the canvas; true where the camera must not move. */
  down?: (x: number, y: number, event: PointerEvent) => boolean;
  move?: (x: number, y: number, event: PointerEvent) => void;
  up?: (x: number, y: number, event: PointerEvent) => void;
  tap?: (index: number, event: PointerEvent) => void;
}

const PICK_PX = 8;
const URL_WAIT_MS = 250;
const AHEAD_MS = 400;

export class ViewerModel {
  readonly first: ViewState;
  readonly state;
  readonly loader: CloudLoader;
  readonly bands: BandSource;
  readonly spectra: SpectraStore;
  readonly layers: LayerModel;
  readonly view = signal<CloudView | null>(null);
  readonly cloud = signal<PointCloud | null>(null);
  readonly colouring = signal<Colouring | null>(null);
  readonly tool = signal<Tool | null>(null);
  /** The point under the pointer, here or in the top view. */
  readonly cursor = signal<number | null>(null);
  /** Whether a tap keeps the spectra of the points before. */
  readonly keep = signal(false);
  /** Whether the spectra of the link have been read: until then they stay in the address. */
  private readonly restored = signal(false);
  /** Takes a tap before the cloud does; true where it was for it. */
  tapFirst: ((x: number, y: number) => boolean) | null = null;
  /** Why the surface cannot be shown. */
  readonly meshProblem = signal<Problem | null>(null);
  private mesh: MeshView | null = null;
  private readonly ends: (() => void)[] = [];
  private urlTimer: ReturnType<typeof setTimeout> | undefined;
  private ahead: ReturnType<typeof setTimeout> | undefined;
  private repaint: ReturnType<typeof setTimeout> | undefined;

  constructor(
    readonly info: CloudInfo,
    query: URLSearchParams,
  ) {
    this.first = firstState(info.wavelength_nm);
    this.state = signal(decode(query, this.first, info.points, info.bands));
    this.loader = new CloudLoader(info.id, (name, start, points) => this.read(name, start, points));
    this.bands = new BandSource(info.id, info.points, info.bands);
    this.spectra = new SpectraStore(info.id, info.bands, info.wavelength_nm);
    this.layers = new LayerModel(info.id, info.points);
    void this.loader.opened.then((cloud) => (this.cloud.value = cloud));
  }

  /** Change parts of the state. */
  patch(change: Partial<ViewState>): void {
    this.state.value = { ...this.state.value, ...change };
  }

  /** Take the picture that has been set up, and keep it in step with the state. */
  attach(view: CloudView): void {
    this.view.value = view;
    const { cloud } = view;
    const shape = this.loader.attributes.cube_shape;
    this.colouring.value = new Colouring({
      cloud,
      cloudId: this.info.id,
      loader: this.loader,
      bands: this.bands,
      cubeShape: Array.isArray(shape) ? (shape as number[]) : [],
    });
    const { camera, chosen } = this.state.peek();
    if (camera) view.setCamera(camera);
    view.onRest = () => this.patch({ camera: view.cameraState });
    this.ends.push(
      effect(() => this.paintWhenDifferent()),
      effect(() => view.setSection(planeOf(this.state.value.section))),
      effect(() => {
        if (this.loader.state.value === "ready") untracked(() => this.readAhead());
      }),
      effect(() => view.setPointScale(this.state.value.size)),
      effect(() => {
        const { shape } = this.state.value;
        // A nearest point is looked for when all are there.
        if (this.loader.state.value === "ready") void untracked(() => this.showShape(view, shape));
      }),
      effect(() => this.showRings(view)),
      effect(() => this.writeUrl()),
      effect(() => {
        const points = this.spectra.points.value;
        if (this.restored.value && JSON.stringify(points) !== JSON.stringify(this.state.peek().chosen)) this.patch({ chosen: points });
      }),
    );
    this.ends.push(effect(() => void this.layers.choose(this.state.value.layer)));
    void this.restoreSpectra(chosen);
  }

  close(): void {
    this.ends.forEach((end) => end());
    clearTimeout(this.urlTimer);
    clearTimeout(this.repaint);
    clearTimeout(this.ahead);
    this.loader.close();
    this.view.value?.dispose();
    this.view.value = null;
  }

  /** The point under a place on the canvas, in CSS pixels. */
  pointAt(x: number, y: number): number | null {
    const view = this.view.value;
    return view && pick(view.cloud, view.projection(), x, y, PICK_PX, view.shownHalf);
  }

  /** Show a point's spectrum. */
  choose(index: number, keep: boolean): Promise<void> {
    return this.spectra.addPoint(index, t("pointNumber", { number: index }), keep);
  }

  /** Read ahead, when nothing else is being read, what the next change of bands needs. */
  private readAhead(): void {
    clearTimeout(this.ahead);
    if (this.loader.state.peek() !== "ready") return;
    this.ahead = setTimeout(() => {
      const { mode, band } = this.state.peek();
      if (!this.bands.sampleNow) {
        // The first band that is read has the service prepare the others.
        void this.bands.sample().then(() => this.bands.exact(band)).catch(noted);
      } else if (mode === "band" && !this.bands.busy) void this.bands.exact(Math.min(band + 1, this.info.bands - 1)).catch(noted);
    }, AHEAD_MS);
  }

  /** Paint again, as after a change of labels. */
  async paint(): Promise<void> {
    const view = this.view.peek();
    const colouring = this.colouring.peek();
    if (!view || !colouring) return;
    const state = this.state.peek();
    await colouring.paint(state, view.colours, () => {
      this.layLabels(view);
      view.recolour();
    });
    this.readAhead();
  }

  private painted = "";

  private paintWhenDifferent(): void {
    const { mode, band, bands, pair, map, range, opacity, layer } = this.state.value;
    const wanted = JSON.stringify([mode, band, bands, pair, map, range, opacity, layer, this.layers.changes.value]);
    if (wanted === this.painted) return;
    this.painted = wanted;
    untracked(() => void this.paint());
  }

  private layLabels(view: CloudView): void {
    const { opacity, layer } = this.state.peek();
    const shown = this.layers.shown.peek();
    if (layer !== null && shown) paintClasses(shown.values, shown.colours, opacity, view.colours);
  }

  private read(name: "chunk_aabb" | "rgb" | "xyz", start: number, points: number): void {
    const view = this.view.peek();
    if (!view) return;
    if (name === "xyz") view.positionsRead(start, points);
    const again = name === "rgb" || (name === "xyz" && this.state.peek().mode === "height");
    if (!again || this.repaint !== undefined) return;
    this.repaint = setTimeout(() => {
      this.repaint = undefined;
      void this.paint();
    }, 30);
  }

  private showRings(view: CloudView): void {
    const cloud = view.cloud;
    const rings = this.spectra.curves.value.flatMap(({ index, colour }) =>
      index === undefined ? [] : [{ place: cloud.place(index), rgb: rgbOf(colour) }],
    );
    const cursor = this.cursor.value;
    if (cursor !== null) rings.push({ place: cloud.place(cursor), rgb: [255, 255, 255] });
    // Positions that come later move the rings.
    if (this.loader.state.value !== "loading") view.setRings(rings);
  }

  private async showShape(view: CloudView, shape: Shape): Promise<void> {
    this.meshProblem.value = null;
    try {
      if (shape !== "cloud" && !this.mesh) {
        const [{ MeshView: Made }, { surfaceOf }] = await Promise.all([import("./render/mesh-view"), import("./measure/surface-source")]);
        const surface = await surfaceOf(this.info.id);
        if (this.view.peek() !== view) return;
        this.mesh ??= new Made(view, surface);
      }
      const now = this.state.peek().shape;
      this.mesh?.show(now !== "cloud");
      view.showPoints(now !== "mesh");
    } catch (thrown) {
      this.meshProblem.value = asProblem(thrown);
    }
  }

  private async restoreSpectra(chosen: readonly number[]): Promise<void> {
    for (const index of chosen) await this.choose(index, true);
    this.restored.value = true;
  }

  private writeUrl(): void {
    const query = encode(this.state.value, this.first);
    clearTimeout(this.urlTimer);
    this.urlTimer = setTimeout(() => setQuery(query), URL_WAIT_MS);
  }
}

/** The half-space that a section shows. */
export function planeOf(section: Section | null): Plane | null {
  if (!section) return null;
  const sign = section.flip ? 1 : -1;
  const part = (axis: string): number => (section.axis === axis ? sign : 0);
  return [part("x"), part("y"), part("z"), -sign * section.at];
}

/** Say what went wrong in a background task, on the console alone: the view goes on without it. */
export function noted(thrown: unknown): void {
  console.warn(asProblem(thrown).message);
}
