/** A file on its way to the service, and what may happen to it. Nothing here touches the browser. */
import type { Problem } from "../../api/problem";

export type Role = "photo" | "cube" | "white" | "dark";

/**
 * `waiting`: to be sent. `sending`, `checking`: on its way; all there, and judged. `resting`: tried again at `retryAt`.
 * `asking`: its bytes are gone with a reload, the same file is to be picked again. `failed`: the service does not take it.
 */
export type State = "waiting" | "sending" | "checking" | "resting" | "asking" | "failed";

/** What is kept of a {@link Problem}: it outlives a reload. */
export type Trouble = Pick<Problem, "code" | "message" | "advice" | "status">;

export interface Item {
  readonly id: string;
  readonly acquisition: string;
  readonly role: Role;
  readonly name: string;
  readonly size: number;
  /** The file's own time, which tells whether one that is picked again is the same. */
  readonly modified: number;
  /** When it was taken or picked, ms since 1970. */
  readonly added: number;
  /** The file of the service that it takes the place of, once it is accepted. */
  readonly replaces: string | null;
  state: State;
  sent: number;
  tries: number;
  retryAt: number;
  trouble: Trouble | null;
}

export type Event =
  | { type: "started" }
  | { type: "progress"; sent: number }
  | { type: "interrupted" }
  | { type: "failed"; trouble: Trouble; retryAfter: number | null; now: number }
  | { type: "again" }
  | { type: "lost" }
  | { type: "found" };

/** What a refusal means for the file, and for those behind it. */
export type Meaning = "later" | "signed-out" | "full" | "final";

const LONGEST_WAIT_MS = 30_000;
const PASSING = new Set([0, 408, 423, 425, 429, 460]);

/** Tell what a refusal of the service means. A file that is too large stays so; a full disk or quota may be emptied. */
export function meaningOf({ status, code }: Pick<Trouble, "status" | "code">): Meaning {
  if (status === 401) return "signed-out";
  if (status === 507 || code === "quota_exceeded") return "full";
  if (PASSING.has(status) || (status >= 500 && status !== 501)) return "later";
  // The offset differs from ours: HEAD tells the right one.
  if (code === "upload_conflict" || code === "upload_gone") return "later";
  return "final";
}

/** Seconds grow with every try: 1, 2, 4 … 30, or what the service asks for. */
export function pauseMs(tries: number, retryAfter: number | null): number {
  return Math.max(Math.min(1000 * 2 ** Math.max(tries - 1, 0), LONGEST_WAIT_MS), (retryAfter ?? 0) * 1000);
}

/** Return the item after an event. */
export function step(item: Item, event: Event): Item {
  switch (event.type) {
    case "started":
      return { ...item, state: "sending", trouble: null };
    case "progress":
      if (item.state !== "sending" && item.state !== "checking") return item;
      // Bytes that arrive end the row of failures.
      return { ...item, sent: event.sent, tries: 0, state: event.sent >= item.size ? "checking" : "sending" };
    case "interrupted":
      return item.state === "sending" || item.state === "checking" ? { ...item, state: "waiting" } : item;
    case "failed": {
      const meaning = meaningOf(event.trouble);
      const { trouble } = event;
      if (meaning === "final") return { ...item, state: "failed", trouble };
      if (meaning !== "later") return { ...item, state: "waiting", trouble };
      const tries = item.tries + 1;
      return { ...item, state: "resting", tries, trouble, retryAt: event.now + pauseMs(tries, event.retryAfter) };
    }
    case "again":
      return item.state === "failed" || item.state === "resting"
        ? { ...item, state: "waiting", tries: 0, retryAt: 0, trouble: null }
        : item;
    case "lost":
      return { ...item, state: "asking" };
    case "found":
      return item.state === "asking" ? { ...item, state: "waiting", trouble: null } : item;
  }
}

/** How many files are sent at a time; photos have places of their own, so that none waits behind a cube. */
export const AT_ONCE = { photo: 2, other: 1 } as const;

const lane = (item: Item): keyof typeof AT_ONCE => (item.role === "photo" ? "photo" : "other");
const busy = (item: Item): boolean => item.state === "sending" || item.state === "checking";

/** The items to start now, oldest first. */
export function due(items: readonly Item[], now: number): Item[] {
  return (["photo", "other"] as const).flatMap((which) => {
    const mine = items.filter((item) => lane(item) === which);
    const free = AT_ONCE[which] - mine.filter(busy).length;
    return mine
      .filter((item) => item.state === "waiting" || (item.state === "resting" && item.retryAt <= now))
      .sort((a, b) => a.added - b.added)
      .slice(0, Math.max(free, 0));
  });
}

/** When the next resting item is due, ms since 1970; null where none rests. */
export function nextDue(items: readonly Item[]): number | null {
  const times = items.filter((item) => item.state === "resting").map((item) => item.retryAt);
  return times.length ? Math.min(...times) : null;
}

/** Whether a file that was picked again is the one that an item lost. */
export function isSame(item: Item, file: { name: string; size: number; lastModified: number }): boolean {
  return item.state === "asking" && item.name === file.name && item.size === file.size && item.modified === file.lastModified;
}
