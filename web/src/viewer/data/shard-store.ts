/** Bytes of a cloud's Zarr group over HTTP, as zarrita asks for them: whole small files, with patience for the service. */
import type { AsyncReadable, RangeQuery } from "zarrita";

/** An answer that will not get better by asking again. */
export class Refusal extends Error {
  constructor(
    readonly status: number,
    readonly text: string,
  ) {
    super(`HTTP ${status}`);
  }
}

/** Statuses after which the same request is right later: locked, too many, a service that starts again. */
const LATER = new Set([423, 429, 502, 503, 504]);
const MOST_WAIT_S = 10;

export interface Patience {
  signal: AbortSignal;
  /** Called when an answer is waited for longer than usual, with the seconds until the next try; 0 when it came. */
  waiting: (seconds: number) => void;
}

/** Fetch, and fetch again while the service is away or busy. Throws a {@link Refusal} for every other failure. */
export async function patientFetch(url: string, options: RequestInit, patience: Patience): Promise<Response> {
  for (let attempt = 0; ; attempt++) {
    let answer: Response | null = null;
    try {
      answer = await fetch(url, { credentials: "same-origin", ...options, signal: patience.signal });
    } catch (error) {
      if (!(error instanceof TypeError)) throw error;
    }
    if (answer?.ok) {
      if (attempt > 0) patience.waiting(0);
      return answer;
    }
    if (answer && !LATER.has(answer.status)) throw new Refusal(answer.status, await answer.text());
    const asked = Number(answer?.headers.get("Retry-After") ?? NaN);
    const wait = Number.isFinite(asked) ? Math.max(asked, 0.2) : Math.min(0.5 * 2 ** attempt, MOST_WAIT_S);
    patience.waiting(wait);
    await new Promise((resolve) => setTimeout(resolve, wait * 1000));
  }
}

/** Cut a part out of a file, as a range request would. */
export function partOf(bytes: Uint8Array<ArrayBuffer>, range: RangeQuery): Uint8Array<ArrayBuffer> {
  if ("suffixLength" in range) return bytes.subarray(Math.max(0, bytes.length - range.suffixLength));
  return bytes.subarray(range.offset, range.offset + range.length);
}

/**
 * Files read whole, once: a shard of positions is a megabyte, and one request is cheaper than its 32 chunks' ranges.
 * `wholeFor` says which; the others are read by range.
 */
export class ShardStore implements AsyncReadable {
  private readonly files = new Map<string, Promise<Uint8Array<ArrayBuffer> | undefined>>();

  constructor(
    private readonly base: string,
    private readonly patience: Patience,
    private readonly wholeFor: (key: string) => boolean,
  ) {}

  async get(key: string): Promise<Uint8Array<ArrayBuffer> | undefined> {
    return this.bytes(key, {});
  }

  async getRange(key: string, range: RangeQuery): Promise<Uint8Array<ArrayBuffer> | undefined> {
    if (!this.wholeFor(key)) {
      const span =
        "suffixLength" in range ? `-${range.suffixLength}` : `${range.offset}-${range.offset + range.length - 1}`;
      return this.bytes(key, { headers: { Range: `bytes=${span}` } });
    }
    let file = this.files.get(key);
    if (!file) this.files.set(key, (file = this.bytes(key, {})));
    const bytes = await file;
    return bytes && partOf(bytes, range);
  }

  /** Forget a file that has been decoded. */
  drop(key: string): void {
    this.files.delete(key);
  }

  private async bytes(key: string, options: RequestInit): Promise<Uint8Array<ArrayBuffer> | undefined> {
    try {
      const answer = await patientFetch(this.base + key, options, this.patience);
      return new Uint8Array(await answer.arrayBuffer());
    } catch (error) {
      // Zarr: a chunk that is not there holds the fill value alone. A cloud that is gone has no zarr.json either.
      if (error instanceof Refusal && error.status === 404 && key !== "/zarr.json") return undefined;
      throw error;
    }
  }
}
