/** What has been painted into a layer, so that it can be taken back and done again. No DOM. */

export interface Edit {
  indices: Uint32Array;
  before: Uint16Array;
  /** The class that all of them were given. */
  after: number;
}

const MOST_BYTES = 64 * 1024 * 1024;

/** Values of a layer with their history. A stroke is one edit, however many points it adds bit by bit. */
export class EditHistory {
  private done: Edit[] = [];
  private undone: Edit[] = [];
  private stroke: { points: Map<number, number>; after: number } | null = null;

  constructor(readonly values: Uint8Array | Uint16Array) {}

  get canUndo(): boolean {
    return this.done.length > 0;
  }

  get canRedo(): boolean {
    return this.undone.length > 0;
  }

  /** Give points a class, as a part of the stroke that is going on. Returns how many have changed. */
  paint(indices: ArrayLike<number>, value: number): number {
    this.stroke ??= { points: new Map(), after: value };
    let changed = 0;
    for (let i = 0; i < indices.length; i++) {
      const index = indices[i] as number;
      const before = this.values[index];
      if (before === undefined || before === value) continue;
      if (!this.stroke.points.has(index)) this.stroke.points.set(index, before);
      this.values[index] = value;
      changed++;
    }
    return changed;
  }

  /** End the stroke. Returns whether it has changed anything. */
  end(): boolean {
    const { stroke } = this;
    this.stroke = null;
    if (!stroke || stroke.points.size === 0) return false;
    this.done.push({
      indices: Uint32Array.from(stroke.points.keys()),
      before: Uint16Array.from(stroke.points.values()),
      after: stroke.after,
    });
    this.undone = [];
    this.forgetOldest();
    return true;
  }

  undo(): void {
    const edit = this.done.pop();
    if (!edit) return;
    edit.indices.forEach((index, i) => (this.values[index] = edit.before[i] ?? 0));
    this.undone.push(edit);
  }

  redo(): void {
    const edit = this.undone.pop();
    if (!edit) return;
    edit.indices.forEach((index) => (this.values[index] = edit.after));
    this.done.push(edit);
  }

  private forgetOldest(): void {
    let bytes = this.done.reduce((sum, edit) => sum + edit.indices.length * 6, 0);
    while (bytes > MOST_BYTES && this.done.length > 1) bytes -= (this.done.shift()?.indices.length ?? 0) * 6;
  }
}
