/** Painting in a label layer: what is painted, how it is saved, what happens when somebody else was quicker. */
import { signal } from "@preact/signals";
import { asProblem, type Problem } from "../../api/problem";
import { session } from "../../app/session";
import { lassoTool } from "../select/lasso-tool";
import type { Tool, ViewerModel } from "../viewer-model";
import { classColours, type LabelClass } from "./classes";
import { EditHistory } from "./edit-history";
import { readLayer, writeLayer } from "./label-layers";
import type { ShownLayer } from "./layer-model";
import { similarPoints } from "./similar";
import { forget, keep, unsavedLayer, whoPaints } from "./unsaved";

export type ToolName = "off" | "brush" | "lasso" | "similar";
const FIRST: LabelClass[] = [
  { value: 0, name: "unlabelled" },
  { value: 1, name: "tumour", colour: "#d62728" },
  { value: 2, name: "healthy", colour: "#2ca02c" },
];

export class Painter {
  readonly cls = signal(1);
  readonly tool = signal<ToolName>("off");
  readonly radius = signal(1);
  readonly reach = signal(10);
  readonly degrees = signal(4);
  readonly dirty = signal(false);
  readonly conflict = signal(false);
  readonly problem = signal<Problem | null>(null);
  readonly saved = signal<number | null>(null);
  readonly gave = signal<number | null>(null);
  readonly busy = signal(false);
  /** Grows with each change, for the buttons. */
  readonly changes = signal(0);
  history: EditHistory | null = null;
  private of: ShownLayer | null = null;
  private seeking = new AbortController();
  private readonly who = whoPaints();

  constructor(private readonly model: ViewerModel) {}

  /** Take the layer that is shown, if it is another than before. A layer of probabilities begins one of classes. */
  take(): void {
    const layer = this.model.layers.shown.value;
    if (layer === this.of || (layer && this.of && layer.values === this.of.values)) return;
    if (layer?.name !== this.of?.name) this.keep();
    this.of = layer;
    const unsaved = layer && unsavedLayer(this.model.info.id, layer.name);
    const same = unsaved?.layer.values === layer?.values;
    this.history = (same && unsaved?.history) || (layer && new EditHistory(layer.values));
    this.dirty.value = unsaved != null && same;
    this.conflict.value = false;
    this.problem.value = null;
    this.saved.value = null;
    const classes = layer?.classes ?? [];
    if (!classes.some(({ value }) => value === this.cls.peek())) this.cls.value = classes.find((c) => c.colour)?.value ?? 0;
  }

  /** Begin a layer that the service does not have yet, empty or from probabilities. */
  begin(name: string, from: ShownLayer | null = null): void {
    const { points, id } = this.model.info;
    if (unsavedLayer(id, name)) {
      this.model.patch({ layer: name });
      return;
    }
    const classes = from ? withUnlabelled(from.classes) : FIRST;
    const largest = Math.max(...classes.map(({ value }) => value));
    const values = largest > 255 ? new Uint16Array(points) : new Uint8Array(points);
    const none = classes.find(({ colour }) => !colour)?.value ?? 0;
    for (let i = 0; i < points; i++) values[i] = from && from.values[i] !== 65535 ? (from.values[i] ?? none) : none;
    this.model.layers.show({ name, version: null, kind: "class", classes, values, colours: classColours(classes), madeBy: "" });
    this.model.patch({ layer: name });
    this.dirty.value = from !== null;
  }

  addClass(name: string, colour: string): void {
    const layer = this.of;
    if (!layer) return;
    const value = Math.max(0, ...layer.classes.map((c) => c.value)) + 1;
    this.change({ ...layer, classes: [...layer.classes, { value, name, colour }] });
    this.cls.value = value;
    this.dirty.value = true;
  }

  choose(name: ToolName): void {
    this.tool.value = name;
    this.model.tool.value = name === "off" ? null : this.toolOf(name);
  }

  undo(): void {
    this.history?.undo();
    this.shown();
  }

  redo(): void {
    this.history?.redo();
    this.shown();
  }

  /** Save a new version; where another version has come meanwhile, say so and keep what was painted. */
  async save(over?: number | null): Promise<void> {
    const layer = this.of;
    if (!layer) return;
    this.busy.value = true;
    this.problem.value = null;
    try {
      const base = over === undefined ? layer.version : over;
      const made = session.value?.name ?? "viewer";
      const label = await writeLayer(this.model.info.id, layer.name, layer.classes, layer.values, base, made);
      this.change({ ...layer, version: label.version, madeBy: made });
      this.saved.value = label.version;
      this.dirty.value = false;
      forget(this.model.info.id, this.who, layer.name);
      this.conflict.value = false;
      await this.model.layers.refresh();
    } catch (thrown) {
      const problem = asProblem(thrown);
      this.conflict.value = problem.status === 412;
      this.problem.value = problem.status === 412 ? null : problem;
    } finally {
      this.busy.value = false;
    }
  }

  /** After a conflict: give up what was painted. */
  takeTheirs(): Promise<void> {
    if (this.of) forget(this.model.info.id, this.who, this.of.name);
    return this.model.layers.read(this.of?.name ?? null);
  }

  /** After a conflict: write what was painted over the version that is there now. */
  async keepMine(): Promise<void> {
    const layer = this.of;
    if (!layer) return;
    try {
      await this.save((await readLayer(this.model.info.id, layer.name)).label.version);
    } catch (thrown) {
      this.problem.value = asProblem(thrown);
    }
  }

  close(): void {
    this.seeking.abort();
    this.choose("off");
    this.keep();
  }

  private keep(): void {
    const { of: layer, history } = this;
    if (layer && history && this.dirty.peek()) keep(this.model.info.id, this.who, { layer, history });
  }

  private toolOf(name: ToolName): Tool {
    if (name === "lasso") return lassoTool(this.model, "paint-lasso", (indices) => this.paintAll(indices));
    if (name === "similar") return { name: "paint-similar", tap: (index) => void this.paintSimilar(index) };
    const stroke = (x: number, y: number): boolean => {
      const index = this.model.pointAt(x, y);
      const { cloud } = this.model.view.value ?? {};
      if (index === null || !cloud) return false;
      if (this.history?.paint(cloud.within(cloud.place(index), this.radius.value), this.cls.value)) this.shown();
      return true;
    };
    return {
      name: "paint-brush",
      down: stroke,
      move: (x, y, event) => {
        if (event.buttons & 1) stroke(x, y);
      },
      up: () => this.endStroke(),
    };
  }

  private paintAll(indices: readonly number[]): void {
    this.gave.value = this.history?.paint(indices, this.cls.value) ?? 0;
    this.endStroke();
    this.shown();
  }

  private async paintSimilar(index: number): Promise<void> {
    const { model } = this;
    const cloud = model.cloud.value;
    if (!cloud) return;
    this.seeking.abort();
    const seeking = (this.seeking = new AbortController());
    this.busy.value = true;
    this.problem.value = null;
    try {
      await model.choose(index, false);
      const spectrum = model.spectra.curves.value.findLast((curve) => curve.index === index)?.mean;
      if (!spectrum) return;
      const usedBands = Array.from({ length: model.info.bands }, (_, band) => !model.info.bad_bands.includes(band));
      const found = await similarPoints(
        model.loader, cloud.bands, cloud.points, cloud.within(cloud.place(index), this.reach.value),
        { spectrum, most: (this.degrees.value * Math.PI) / 180, usedBands }, seeking.signal,
      );
      if (!seeking.signal.aborted) this.paintAll(found);
    } catch (thrown) {
      this.problem.value = asProblem(thrown);
    } finally {
      if (seeking === this.seeking) this.busy.value = false;
    }
  }

  private endStroke(): void {
    if (this.history?.end()) {
      this.dirty.value = true;
      this.saved.value = null;
    }
    this.changes.value++;
  }

  private change(layer: ShownLayer): void {
    this.of = { ...layer, colours: classColours(layer.classes) };
    this.model.layers.show(this.of);
  }

  private shown(): void {
    this.changes.value++;
    this.model.layers.changes.value++;
  }
}

/** Classes with one for points that nobody has labelled. */
function withUnlabelled(classes: readonly LabelClass[]): LabelClass[] {
  if (classes.some(({ colour }) => !colour)) return [...classes];
  const value = Math.max(0, ...classes.map((c) => c.value)) + 1;
  return [...classes, { value, name: classes.some((c) => c.name === "unlabelled") ? `unlabelled ${value}` : "unlabelled" }];
}
