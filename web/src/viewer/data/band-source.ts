/** Bands of all points: a coarse picture at once, from an even sample of spectra; the exact one when it has come. */
import { fetched } from "../../api/client";
import { readNpy } from "./npy";
import { bandOfSample, sampleStep, type Sample } from "./sample";

const KEPT = 12;
const NPY = { Accept: "application/x-npy" };

export interface Band {
  values: Float32Array<ArrayBuffer>;
  exact: boolean;
}

export class BandSource {
  private readonly kept = new Map<number, Float32Array<ArrayBuffer>>();
  private readonly coming = new Map<number, Promise<Float32Array<ArrayBuffer>>>();
  private sampled: Promise<Sample> | null = null;
  private known: Sample | null = null;

  constructor(
    private readonly cloudId: string,
    private readonly points: number,
    private readonly bands: number,
  ) {}

  /** What is there of a band at this moment. */
  now(band: number): Band | null {
    const kept = this.kept.get(band);
    if (kept) {
      this.keep(band, kept);
      return { values: kept, exact: true };
    }
    if (!this.known) return null;
    return { values: bandOfSample(this.known, band, this.bands, this.points), exact: false };
  }

  /** All values of a band. */
  exact(band: number): Promise<Float32Array<ArrayBuffer>> {
    const kept = this.kept.get(band);
    if (kept) return Promise.resolve(kept);
    let coming = this.coming.get(band);
    if (!coming) {
      coming = fetched(`/v1/clouds/${this.cloudId}/bands/${band}`, { headers: NPY })
        .then(async (answer) => {
          const values = readNpy(await answer.arrayBuffer()).values as Float32Array<ArrayBuffer>;
          this.keep(band, values);
          return values;
        })
        .finally(() => this.coming.delete(band));
      this.coming.set(band, coming);
    }
    return coming;
  }

  /** Whether a band is being read: the service reads few at a time. */
  get busy(): boolean {
    return this.coming.size > 0;
  }

  /** Spectra of an even sample of the points; read once. */
  sample(): Promise<Sample> {
    this.sampled ??= this.readSample().catch((error: unknown) => {
      this.sampled = null;
      throw error;
    });
    return this.sampled;
  }

  get sampleNow(): Sample | null {
    return this.known;
  }

  private async readSample(): Promise<Sample> {
    const step = sampleStep(this.points, this.bands);
    const count = Math.ceil(this.points / step);
    // The middle of each run stands for it best.
    const indices = Array.from({ length: count }, (_, i) => Math.min(i * step + step / 2, this.points - 1));
    const answer = await fetched(`/v1/clouds/${this.cloudId}/spectra`, {
      method: "POST",
      headers: { ...NPY, "Content-Type": "application/json" },
      body: JSON.stringify({ select: { indices }, limit: count }),
    });
    const spectra = readNpy(await answer.arrayBuffer()).values as Float32Array;
    this.known = { step, count, spectra };
    return this.known;
  }

  private keep(band: number, values: Float32Array<ArrayBuffer>): void {
    this.kept.delete(band);
    this.kept.set(band, values);
    for (const oldest of this.kept.keys()) {
      if (this.kept.size <= KEPT) break;
      this.kept.delete(oldest);
    }
  }
}
