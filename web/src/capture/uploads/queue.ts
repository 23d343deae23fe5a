/** The files of this browser on their way to the service. It belongs to no page: it goes on while others are shown. */
import { signal } from "@preact/signals";
import { asProblem } from "../../api/problem";
import { session, sessionLost } from "../../app/session";
import type { File as StoredFile } from "../photos/checks";
import { due, isSame, meaningOf, nextDue, step, type Event, type Item, type Role, type Trouble } from "./item";
import { send, type Sending } from "./send";
import * as storage from "./storage";
import { randomId } from "../../ui/browser";

/** All files on their way, of all acquisitions. */
export const items = signal<readonly Item[]>([]);
/** Why nothing is sent, where the service has no room. */
export const full = signal<Trouble | null>(null);
/** Whether files cannot be kept over a reload, as in a private window. */
export const forgetful = signal(false);
/** Whether another tab of this browser sends. */
export const elsewhere = signal(false);

/** How long the queue waits by itself for room. */
const FULL_PAUSE_MS = 60_000;

type Listener = (item: Item, file: StoredFile) => void;
const listeners = new Set<Listener>();
/** Bytes that are not kept, or not yet: the File as it was picked. */
const held = new Map<string, Blob>();
const running = new Map<string, Sending>();
let timer: ReturnType<typeof setTimeout> | undefined;
let begun = false;

/** Call back for each file that the service has judged. Returns a function that ends that. */
export function onArrival(listener: Listener): () => void {
  listeners.add(listener);
  return () => listeners.delete(listener);
}

export interface Addition {
  acquisition: string;
  role: Role;
  file: Blob;
  name: string;
  replaces?: string | null;
}

/** Add a file: it is kept first, then sent. */
export async function add({ acquisition, role, file, name, replaces = null }: Addition): Promise<Item> {
  const item: Item = {
    id: randomId(),
    acquisition,
    role,
    name,
    size: file.size,
    modified: file instanceof File ? file.lastModified : Date.now(),
    added: Date.now(),
    replaces,
    state: "waiting",
    sent: 0,
    tries: 0,
    retryAt: 0,
    trouble: null,
  };
  held.set(item.id, file);
  try {
    await storage.keep(item, (await storage.fits(file.size)) ? file : undefined);
  } catch {
    forgetful.value = true;
  }
  // Shown only now: what is seen on the page outlives a reload.
  items.value = [...items.value, item];
  pump();
  return item;
}

/** Give bytes back to the items that lost them; returns the files that belong to none. */
export function giveBack(acquisition: string, files: readonly File[]): File[] {
  return files.filter((file) => {
    const item = items.value.find((one) => one.acquisition === acquisition && isSame(one, file));
    if (!item) return true;
    held.set(item.id, file);
    change(item.id, { type: "found" });
    pump();
    return false;
  });
}

/** Try a failed or resting file now. */
export function again(id: string): void {
  change(id, { type: "again" });
  pump();
}

/** Try everything now: the connection is back, or room was made. */
export function againAll(): void {
  full.value = null;
  for (const { id, state } of items.value) if (state === "resting") change(id, { type: "again" });
  pump();
}

/** Give a file up. */
export function discard(id: string): void {
  running.get(id)?.stop();
  running.delete(id);
  held.delete(id);
  items.value = items.value.filter((item) => item.id !== id);
  void storage.forget(id).catch(() => undefined);
  pump();
}

/** Begin: what was left by the page's last life goes on. May be called again. */
export function begin(): void {
  if (begun) return;
  begun = true;
  addEventListener("online", againAll);
  document.addEventListener("visibilitychange", () => {
    // Timers sleep with the tablet.
    if (!document.hidden) againAll();
  });
  void storage.keepForGood();
  const load = async (): Promise<void> => {
    const known = new Set(items.value.map(({ id }) => id));
    const old = (await storage.kept().catch(() => [])).filter(({ id }) => !known.has(id));
    items.value = [...old.map((item) => step(item, { type: "interrupted" })), ...items.value];
    // Signing in starts what waited for it.
    session.subscribe((now) => {
      if (now) pump();
    });
  };
  // Two tabs would send each file twice.
  if (!("locks" in navigator)) return void load();
  elsewhere.value = true;
  void navigator.locks.request("specimap.uploads", async () => {
    elsewhere.value = false;
    await load();
    await new Promise(() => undefined);
  });
}

function change(id: string, event: Event): void {
  const before = items.value.find((item) => item.id === id);
  if (!before) return;
  const after = step(before, event);
  items.value = items.value.map((item) => (item === before ? after : item));
  if (event.type !== "progress") void storage.keep(after).catch(() => undefined);
}

function pump(): void {
  clearTimeout(timer);
  if (!session.value || elsewhere.value || full.value) return;
  const now = Date.now();
  for (const item of due(items.value, now)) void start(item);
  const next = nextDue(items.value);
  if (next !== null) timer = setTimeout(pump, Math.max(next - now, 50));
}

async function start(item: Item): Promise<void> {
  change(item.id, { type: "started" });
  const bytes = held.get(item.id) ?? (await storage.bytesOf(item.id).catch(() => undefined));
  if (!bytes) {
    change(item.id, { type: "lost" });
    pump();
    return;
  }
  const sending = send(item, bytes, (sent) => change(item.id, { type: "progress", sent }));
  running.set(item.id, sending);
  try {
    const file = await sending.done;
    held.delete(item.id);
    items.value = items.value.filter(({ id }) => id !== item.id);
    listeners.forEach((listener) => listener(item, file));
    await storage.forget(item.id).catch(() => undefined);
  } catch (thrown) {
    const { code, message, advice, status, retryAfter } = asProblem(thrown);
    const trouble = { code, message, advice, status };
    if (meaningOf(trouble) === "full") {
      full.value = trouble;
      setTimeout(againAll, FULL_PAUSE_MS);
    }
    if (meaningOf(trouble) === "signed-out") {
      sessionLost.value = true;
      session.value = null;
    }
    change(item.id, { type: "failed", trouble, retryAfter, now: Date.now() });
  } finally {
    running.delete(item.id);
    pump();
  }
}
