/** The label layers that can be shown, and the one that is. */
import { signal } from "@preact/signals";
import { asProblem, type Problem } from "../../api/problem";
import { classColours, mostProbable, type LabelClass } from "./classes";
import { listLayers, readLayer, type Label } from "./label-layers";
import { unsavedLayer } from "./unsaved";

export interface ShownLayer {
  name: string;
  /** Version that the values began as; null: a layer that is not stored yet. */
  version: number | null;
  kind: string;
  classes: readonly LabelClass[];
  /** A class number for each point. */
  values: Uint8Array | Uint16Array;
  colours: Uint8Array;
  madeBy: string;
}

export class LayerModel {
  readonly list = signal<readonly Label[]>([]);
  readonly shown = signal<ShownLayer | null>(null);
  readonly problem = signal<Problem | null>(null);
  /** Grows with each change of what is shown. */
  readonly changes = signal(0);
  private round = 0;

  constructor(
    readonly cloudId: string,
    readonly points: number,
  ) {}

  async refresh(): Promise<void> {
    try {
      this.list.value = await listLayers(this.cloudId);
    } catch (thrown) {
      this.problem.value = asProblem(thrown);
    }
  }

  /** Show a layer; null: none. A layer that is shown already stays as it is, with what has been painted in it. */
  async choose(name: string | null): Promise<void> {
    if (name === (this.shown.peek()?.name ?? null)) return;
    await this.read(name);
  }

  /** Read the current version of a layer, or none; one with changes that are not saved is shown with them. */
  async read(name: string | null): Promise<void> {
    const round = ++this.round;
    this.problem.value = null;
    if (name === null) {
      this.show(null);
      return;
    }
    const unsaved = unsavedLayer(this.cloudId, name);
    if (unsaved) {
      this.show(unsaved.layer);
      return;
    }
    try {
      const { label, values } = await readLayer(this.cloudId, name);
      if (round !== this.round) return;
      const own = values instanceof Float32Array ? mostProbable(values, this.points, label.classes, 65535) : values;
      this.show({
        name,
        version: label.version,
        kind: label.kind,
        classes: label.classes,
        values: own,
        colours: classColours(label.classes),
        madeBy: label.made_by.name,
      });
    } catch (thrown) {
      if (round === this.round) this.problem.value = asProblem(thrown);
    }
  }

  /** Show a layer, or what has been changed of it. */
  show(layer: ShownLayer | null): void {
    this.shown.value = layer;
    this.changes.value++;
  }

  /** Points of each class, by class number. */
  counts(): Map<number, number> {
    const found = new Map<number, number>();
    this.shown.value?.values.forEach((value) => found.set(value, (found.get(value) ?? 0) + 1));
    return found;
  }
}
