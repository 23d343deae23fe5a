/** The points of a cloud in the page's memory, as far as they have been read. */

/** Points of one chunk: what `chunk_aabb` has a box for. */
export const CHUNK = 256;
/** Where points lie that have not been read: no camera sees it. */
export const NOWHERE = 1e9;

export class PointCloud {
  /** mm, marker frame; {@link NOWHERE} until read. */
  readonly xyz: Float32Array<ArrayBuffer>;
  readonly rgb: Uint8Array<ArrayBuffer>;
  /** Boxes of each {@link CHUNK} points: least x y z, largest x y z. */
  boxes: Float32Array<ArrayBuffer>;
  /** Whether the positions of a chunk have been read. */
  readonly known: Uint8Array<ArrayBuffer>;
  loaded = 0;

  constructor(
    readonly points: number,
    readonly bands: number,
  ) {
    this.xyz = new Float32Array(points * 3).fill(NOWHERE);
    this.rgb = new Uint8Array(points * 3).fill(128);
    this.boxes = new Float32Array(0);
    this.known = new Uint8Array(Math.ceil(points / CHUNK));
  }

  get complete(): boolean {
    return this.loaded >= this.points;
  }

  takePositions(start: number, values: Float32Array): void {
    this.xyz.set(values, start * 3);
    this.loaded += values.length / 3;
    this.known.fill(1, Math.floor(start / CHUNK), Math.ceil((start + values.length / 3) / CHUNK));
  }

  place(index: number): [number, number, number] {
    return [this.xyz[index * 3] ?? 0, this.xyz[index * 3 + 1] ?? 0, this.xyz[index * 3 + 2] ?? 0];
  }

  /** Least and largest x, y, z of all points, mm. */
  bounds(): { low: [number, number, number]; high: [number, number, number] } {
    const low: [number, number, number] = [Infinity, Infinity, Infinity];
    const high: [number, number, number] = [-Infinity, -Infinity, -Infinity];
    for (let i = 0; i < this.boxes.length; i++) {
      const axis = (i % 3) as 0 | 1 | 2;
      const value = this.boxes[i] ?? 0;
      if (i % 6 < 3) low[axis] = Math.min(low[axis], value);
      else high[axis] = Math.max(high[axis], value);
    }
    return { low, high };
  }

  /** Call back for the points of each chunk whose box passes a test. */
  forChunks(test: (box: number) => boolean, visit: (start: number, stop: number) => void): void {
    for (let chunk = 0; chunk < this.known.length; chunk++) {
      if (this.known[chunk] && test(chunk * 6)) visit(chunk * CHUNK, Math.min((chunk + 1) * CHUNK, this.points));
    }
  }

  /** Points at most `radius` mm from a place. */
  within(place: readonly [number, number, number], radius: number): number[] {
    const found: number[] = [];
    const [x, y, z] = place;
    const square = radius * radius;
    const { boxes, xyz } = this;
    const apart = (low: number, high: number, at: number): number => Math.max(low - at, 0, at - high);
    this.forChunks(
      (b) =>
        apart(boxes[b] ?? 0, boxes[b + 3] ?? 0, x) ** 2 +
          apart(boxes[b + 1] ?? 0, boxes[b + 4] ?? 0, y) ** 2 +
          apart(boxes[b + 2] ?? 0, boxes[b + 5] ?? 0, z) ** 2 <=
        square,
      (start, stop) => {
        for (let i = start; i < stop; i++) {
          const dx = (xyz[i * 3] ?? 0) - x, dy = (xyz[i * 3 + 1] ?? 0) - y, dz = (xyz[i * 3 + 2] ?? 0) - z;
          if (dx * dx + dy * dy + dz * dz <= square) found.push(i);
        }
      },
    );
    return found;
  }

  /** Distance between neighbours, mm: the median of the root of a chunk's area over its points. */
  spacing(): number {
    const found: number[] = [];
    for (let b = 0; b < this.boxes.length; b += 6) {
      const dx = (this.boxes[b + 3] ?? 0) - (this.boxes[b] ?? 0), dy = (this.boxes[b + 4] ?? 0) - (this.boxes[b + 1] ?? 0);
      found.push(Math.sqrt((dx * dy) / CHUNK));
    }
    return found.sort((a, b) => a - b)[found.length >> 1] ?? 0.1;
  }
}
