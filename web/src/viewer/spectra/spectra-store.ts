/** The spectra that are looked at together: of points, regions, classes and references. */
import { computed, signal } from "@preact/signals";
import { api, body, fetched } from "../../api/client";
import { asProblem, type Problem } from "../../api/problem";
import { distinct } from "../colour/colour-maps";
import { readNpy } from "../data/npy";
import { MOST_CHOSEN } from "../view-state";
import { meanAndDeviation, resampled } from "./statistics";
import type { Reference } from "./csv";

export interface SpectrumCurve {
  id: string;
  kind: "point" | "region" | "class" | "reference";
  name: string;
  colour: string;
  mean: Float64Array | Float32Array;
  sd?: Float64Array;
  /** Points that it is the mean of. */
  n: number;
  /** Of a point alone. */
  index?: number;
  details?: PointDetails;
}

export interface PointDetails {
  xyz: number[];
  sigma_mm: number | null;
  flag_names: string[];
  hsi_pixel: number[];
  labels: Record<string, unknown>;
}

/** Points whose spectra are averaged at most; of larger regions an even part is taken. */
const MOST_AVERAGED = 20_000;
const MOST_VALUES = 8_000_000;

export class SpectraStore {
  readonly curves = signal<readonly SpectrumCurve[]>([]);
  readonly problem = signal<Problem | null>(null);
  readonly busy = signal(false);
  /** Milliseconds from the last tap to its spectrum. */
  readonly lastMs = signal(0);
  readonly points = computed(() => this.curves.value.flatMap((curve) => (curve.index === undefined ? [] : [curve.index])));
  private count = 0;

  constructor(
    private readonly cloudId: string,
    private readonly bands: number,
    private readonly wavelengths: readonly (number | null)[],
  ) {}

  /** Show the spectrum of a point; `keep` leaves those of other points. */
  addPoint(index: number, name: string, keep: boolean): Promise<void> {
    const began = performance.now();
    return this.during(async () => {
      const point = await body(
        api.GET("/v1/clouds/{cloud_id}/points/{index}", { params: { path: { cloud_id: this.cloudId, index } } }),
      );
      const mean = Float64Array.from(point.spectrum, (value) => value ?? NaN);
      const others = this.curves.value.filter((c) => (c.kind === "point" ? keep && c.index !== index : true));
      this.put(others, { kind: "point", name, mean, n: 1, index, details: point });
      this.lastMs.value = performance.now() - began;
    });
  }

  /** Show mean and deviation over points. */
  addRegion(indices: readonly number[], name: string, kind: "region" | "class" = "region"): Promise<void> {
    return this.during(async () => {
      const most = Math.max(1, Math.min(MOST_AVERAGED, Math.floor(MOST_VALUES / this.bands)));
      const step = Math.max(1, indices.length / most);
      const chosen = Array.from({ length: Math.floor(indices.length / step) }, (_, i) => indices[Math.floor(i * step)] ?? 0);
      if (chosen.length === 0) return;
      const answer = await fetched(`/v1/clouds/${this.cloudId}/spectra`, {
        method: "POST",
        headers: { Accept: "application/x-npy", "Content-Type": "application/json" },
        body: JSON.stringify({ select: { indices: chosen }, limit: chosen.length }),
      });
      const { mean, sd } = meanAndDeviation(readNpy(await answer.arrayBuffer()).values as Float32Array, this.bands);
      this.put(this.curves.value, { kind, name, mean, sd, n: indices.length });
    });
  }

  addReference(reference: Reference): void {
    this.put(this.curves.value, {
      kind: "reference",
      name: reference.name,
      mean: resampled(reference.nm, reference.values, this.wavelengths),
      n: 0,
    });
  }

  remove(id: string): void {
    this.curves.value = this.curves.value.filter((curve) => curve.id !== id);
  }

  clear(): void {
    this.curves.value = [];
  }

  private put(others: readonly SpectrumCurve[], curve: Omit<SpectrumCurve, "id" | "colour">): void {
    const kept = others.slice(-(MOST_CHOSEN - 1));
    const taken = new Set(kept.map((c) => c.colour));
    let colour = distinct(0);
    for (let i = 0; i < MOST_CHOSEN && taken.has(colour); i++) colour = distinct(i + 1);
    this.curves.value = [...kept, { ...curve, id: `curve-${this.count++}`, colour }];
  }

  private async during(work: () => Promise<void>): Promise<void> {
    this.busy.value = true;
    this.problem.value = null;
    try {
      await work();
    } catch (thrown) {
      this.problem.value = asProblem(thrown);
    } finally {
      this.busy.value = false;
    }
  }
}
