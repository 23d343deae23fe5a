/** A refusal of the service (application/problem+json), or the loss of the connection to it. */
export class Problem extends Error {
  constructor(
    /** Stable code of docs/errors.md; `network_lost` where no answer came. */
    readonly code: string,
    message: string,
    readonly advice: string,
    /** HTTP status; 0 where no answer came. */
    readonly status: number,
    readonly details: Record<string, unknown> = {},
    /** Seconds to wait before another try, where the service says so. */
    readonly retryAfter: number | null = null,
  ) {
    super(message);
    this.name = "Problem";
  }
}

/** Make a problem of an answer that is no success; its body may be anything. */
export async function problemOf(answer: Response): Promise<Problem> {
  return problemFrom(await answer.text().catch(() => ""), answer.status, answer.headers.get("Retry-After"));
}

/** Make a problem of an answer's body, status and Retry-After header. */
export function problemFrom(text: string, status: number, after: string | null = null): Problem {
  let body: Record<string, unknown> = {};
  try {
    const parsed: unknown = JSON.parse(text);
    if (typeof parsed === "object" && parsed !== null) body = parsed as Record<string, unknown>;
  } catch {
    // A proxy's own page: the status is all there is.
  }
  const wait = after === null ? NaN : Number(after);
  return new Problem(
    word(body.code) ?? `http_${status}`,
    word(body.detail) ?? word(body.title) ?? `HTTP ${status}`,
    word(body.advice) ?? "",
    status,
    typeof body.details === "object" && body.details !== null ? (body.details as Record<string, unknown>) : {},
    Number.isFinite(wait) ? wait : null,
  );
}

/** Make a problem of whatever was thrown. */
export function asProblem(thrown: unknown): Problem {
  if (thrown instanceof Problem) return thrown;
  if (thrown instanceof TypeError) return new Problem("network_lost", "No connection to the service.", "", 0);
  return new Problem("page_failed", thrown instanceof Error ? thrown.message : String(thrown), "", 0);
}

function word(value: unknown): string | null {
  return typeof value === "string" && value !== "" ? value : null;
}
