/** One file sent by the tus protocol: it goes on from where it stopped, also after a reload. */
import { DetailedError, Upload, type HttpRequest, type HttpResponse } from "tus-js-client";
import { api, BASE, body, PAGE_HEADER } from "../../api/client";
import { asProblem, Problem, problemFrom } from "../../api/problem";
import type { File } from "../photos/checks";
import type { Item } from "./item";

const CHUNK = 8 * 1024 * 1024;
/** Answers to HEAD after which another upload is begun: it is gone, or another key's. */
const GONE = new Set([403, 404, 410]);

export interface Sending {
  /** The stored file with its judgement. Rejects with a {@link Problem}. */
  readonly done: Promise<File>;
  /** Stop; what has arrived stays. */
  stop(): void;
}

/** Send a file's bytes; `progress` is told how many have arrived. */
export function send(item: Item, bytes: Blob, progress: (sent: number) => void): Sending {
  let round = "";
  const checked = (request: HttpRequest, answer: HttpResponse): void => {
    const status = answer.getStatus();
    if (status < 400) return;
    if (request.getMethod() === "HEAD" && GONE.has(status)) {
      round = `-${Date.now()}`;
      return;
    }
    // Thrown before the library draws conclusions of its own, which would forget how much had arrived.
    throw problemFrom(answer.getBody(), status, answer.getHeader("Retry-After") ?? null);
  };
  let upload: Upload | null = null;
  const sent = new Promise<string>((resolve, reject) => {
    const made = new Upload(bytes, {
      endpoint: `${BASE}/v1/uploads`,
      headers: PAGE_HEADER,
      metadata: { acquisition: item.acquisition, role: item.role, filename: item.name },
      chunkSize: CHUNK,
      retryDelays: null,
      removeFingerprintOnSuccess: true,
      fingerprint: () => Promise.resolve(`specimap-${item.id}`),
      onBeforeRequest: (request) => {
        // A lost answer makes no second upload.
        if (request.getMethod() === "POST") request.setHeader("Idempotency-Key", item.id + round);
      },
      onAfterResponse: checked,
      onProgress: progress,
      onSuccess: () => resolve(made.url ?? ""),
      onError: (error) => reject(problemOfUpload(error)),
    });
    upload = made;
    made.findPreviousUploads().then(
      ([previous]) => {
        if (previous) made.resumeFromPreviousUpload(previous);
        made.start();
      },
      (thrown: unknown) => reject(asProblem(thrown)),
    );
  });
  return {
    done: sent.then(async (url) => await resultOf(url.split("/").pop() ?? "")),
    stop: () => void upload?.abort().catch(() => undefined),
  };
}

function problemOfUpload(error: Error): Problem {
  const cause = error instanceof DetailedError ? error.causingError : error;
  if (cause instanceof Problem) return cause;
  // The browser could not read the file: it was moved or changed since it was picked.
  if (cause instanceof DOMException && cause.name === "NotReadableError") return asProblem(cause);
  return new Problem("network_lost", error.message, "", 0);
}

async function resultOf(upload_id: string): Promise<File> {
  const result = await body(api.GET("/v1/uploads/{upload_id}/result", { params: { path: { upload_id } } }));
  if (result.file) return result.file;
  const { error } = result;
  if (error) throw new Problem(error.code, error.message, error.advice, 422);
  // It was deleted since, by somebody else.
  throw new Problem("upload_gone", "The upload has ended.", "", result.state === "finished" ? 404 : 410);
}
