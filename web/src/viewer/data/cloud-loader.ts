/** The page's side of the reader: a cloud that fills up while it is read. */
import { signal } from "@preact/signals";
import { BASE } from "../../api/client";
import { Problem, problemFrom } from "../../api/problem";
import { PointCloud } from "./point-cloud";
import type { Ask, Decode, Tell, Values } from "./cloud-reader.worker";
import type { Span } from "./shard-plan";

export type LoadState = "loading" | "coarse" | "ready";

interface Wanted {
  part: (start: number, values: Values) => void;
  done: () => void;
  failed: (problem: Problem) => void;
}

/** Opens a cloud and reads its arrays in a worker. `changed` is called with each part of positions or colours. */
export class CloudLoader {
  readonly state = signal<LoadState>("loading");
  readonly problem = signal<Problem | null>(null);
  /** Seconds until the reader asks again, while the service does not answer; 0 while it does. */
  readonly waiting = signal(0);
  readonly opened: Promise<PointCloud>;
  attributes: Record<string, unknown> = {};
  decode: Decode = { scale: 1, offset: 0, fill: null };
  private cloud: PointCloud | null = null;
  private readonly worker: Worker;
  private readonly wanted = new Map<number, Wanted>();
  private readonly arrays = new Map<string, Promise<Values>>();
  private next = 0;

  constructor(
    cloudId: string,
    private readonly changed: (name: "chunk_aabb" | "rgb" | "xyz", start: number, points: number) => void,
  ) {
    this.worker = new Worker(new URL("./cloud-reader.worker.ts", import.meta.url), { type: "module" });
    this.opened = new Promise((resolve) => {
      this.worker.onmessage = ({ data }: MessageEvent<Tell>) => this.take(data, resolve);
    });
    this.worker.onerror = (event) => (this.problem.value = broken(event.message));
    this.ask({ kind: "open", url: `${BASE}/v1/clouds/${cloudId}/zarr` });
  }

  close(): void {
    this.worker.terminate();
  }

  /** Read a whole array of the points; it is kept. */
  array(name: string, width: number): Promise<Values> {
    let values = this.arrays.get(name);
    if (!values) {
      values = this.opened.then((cloud) => this.whole(name, cloud.points * width));
      values.catch(() => this.arrays.delete(name));
      this.arrays.set(name, values);
    }
    return values;
  }

  /** Forget a kept array, such as a label layer that has a new version. */
  forget(name: string): void {
    this.arrays.delete(name);
  }

  /** Read stored spectra of spans of points, in any order of spans. */
  spectra(spans: Span[], part: (start: number, values: Uint16Array) => void, signal?: AbortSignal): Promise<void> {
    return new Promise((resolve, reject) => {
      const id = this.next++;
      signal?.addEventListener("abort", () => this.ask({ kind: "stop", id }));
      this.wanted.set(id, {
        part: (start, values) => !signal?.aborted && part(start, values as Uint16Array),
        done: resolve,
        failed: reject,
      });
      this.ask({ kind: "spectra", id, spans });
    });
  }

  private whole(name: string, length: number): Promise<Values> {
    return new Promise((resolve, reject) => {
      const id = this.next++;
      let all: Values | null = null;
      let got = 0;
      this.wanted.set(id, {
        part: (start, values) => {
          all ??= like(values, length);
          got += values.length;
          // Parts of an array of two axes begin at `start` times its width.
          all.set(values, start * Math.round(length / (this.cloud?.points ?? length)));
        },
        done: () => (all && got === length ? resolve(all) : reject(broken(`${name} is not whole`))),
        failed: reject,
      });
      this.ask({ kind: "array", id, name });
    });
  }

  private take(message: Tell, resolve: (cloud: PointCloud) => void): void {
    switch (message.kind) {
      case "opened": {
        this.attributes = message.attributes;
        this.decode = message.decode;
        this.cloud = new PointCloud(message.points, message.bands);
        resolve(this.cloud);
        return;
      }
      case "part":
        if (message.id !== undefined) this.wanted.get(message.id)?.part(message.start, message.values);
        else this.fill(message.name, message.start, message.values);
        return;
      case "done":
        if (message.id === undefined) this.state.value = "ready";
        else this.end(message.id)?.done();
        return;
      case "waiting":
        this.waiting.value = message.seconds;
        return;
      case "failed": {
        const problem = message.status === 0 ? broken(message.text) : problemFrom(message.text, message.status);
        if (message.id === undefined) this.problem.value = problem;
        else this.end(message.id)?.failed(problem);
      }
    }
  }

  private fill(name: string, start: number, values: Values): void {
    const { cloud } = this;
    if (!cloud) return;
    if (name === "chunk_aabb") {
      cloud.boxes = values as Float32Array<ArrayBuffer>;
      this.state.value = "coarse";
      this.changed("chunk_aabb", 0, cloud.points);
    } else if (name === "rgb") {
      cloud.rgb.set(values, start * 3);
      this.changed("rgb", start, values.length / 3);
    } else {
      cloud.takePositions(start, values as Float32Array);
      this.changed("xyz", start, values.length / 3);
    }
  }

  private end(id: number): Wanted | undefined {
    const wanted = this.wanted.get(id);
    this.wanted.delete(id);
    return wanted;
  }

  private ask(message: Ask): void {
    this.worker.postMessage(message);
  }
}

function broken(text: string): Problem {
  return new Problem("page_failed", text, "", 0);
}

function like(values: Values, length: number): Values {
  if (values instanceof Float32Array) return new Float32Array(length);
  return values instanceof Uint16Array ? new Uint16Array(length) : new Uint8Array(length);
}
