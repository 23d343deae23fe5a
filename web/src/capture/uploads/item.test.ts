import { describe, expect, it } from "vitest";
import { AT_ONCE, due, isSame, meaningOf, nextDue, pauseMs, step, type Item, type Trouble } from "./item";

const item = (over: Partial<Item> = {}): Item => ({
  id: "a",
  acquisition: "acq_1",
  role: "photo",
  name: "a.jpg",
  size: 100,
  modified: 5,
  added: 1,
  replaces: null,
  state: "waiting",
  sent: 0,
  tries: 0,
  retryAt: 0,
  trouble: null,
  ...over,
});
const trouble = (status: number, code = `http_${status}`): Trouble => ({ status, code, message: "", advice: "" });
const failed = (from: Item, status: number, retryAfter: number | null = null, code?: string): Item =>
  step(from, { type: "failed", trouble: trouble(status, code), retryAfter, now: 1000 });

describe("a file on its way", () => {
  it("is sent, checked when all bytes are there", () => {
    let now = step(item(), { type: "started" });
    expect(now.state).toBe("sending");
    now = step(now, { type: "progress", sent: 60 });
    expect([now.state, now.sent]).toEqual(["sending", 60]);
    expect(step(now, { type: "progress", sent: 100 }).state).toBe("checking");
  });

  it("rests longer after each failure, and less once bytes arrive", () => {
    let now = item();
    const waits = [1, 2, 3, 4, 5, 6, 7].map(() => {
      now = failed(now, 0);
      return now.retryAt - 1000;
    });
    expect(waits).toEqual([1000, 2000, 4000, 8000, 16000, 30000, 30000]);
    now = step(step(now, { type: "started" }), { type: "progress", sent: 1 });
    expect(failed(now, 0).retryAt).toBe(2000);
  });

  it("waits as long as the service asks", () => expect(failed(item(), 429, 12).retryAt).toBe(13000));

  it("keeps its place when nobody is signed in or nothing fits", () => {
    expect(failed(item(), 401).state).toBe("waiting");
    expect(failed(item(), 507).state).toBe("waiting");
    expect(failed(item(), 413, null, "quota_exceeded").state).toBe("waiting");
  });

  it("fails for good where the same request would be refused again, and can be told to try", () => {
    const now = failed(item(), 413, null, "payload_too_large");
    expect(now.state).toBe("failed");
    expect(step(now, { type: "again" })).toMatchObject({ state: "waiting", trouble: null });
  });

  it("waits again after an interruption, wherever it was", () => {
    expect(step(item({ state: "checking" }), { type: "interrupted" }).state).toBe("waiting");
    expect(step(item({ state: "failed" }), { type: "interrupted" }).state).toBe("failed");
  });

  it("asks for its bytes where they are gone, and knows them again", () => {
    const now = step(item(), { type: "lost" });
    expect(isSame(now, { name: "a.jpg", size: 100, lastModified: 5 })).toBe(true);
    expect(isSame(now, { name: "a.jpg", size: 100, lastModified: 6 })).toBe(false);
    expect(isSame(item(), { name: "a.jpg", size: 100, lastModified: 5 })).toBe(false);
    expect(step(now, { type: "found" }).state).toBe("waiting");
  });

  it("takes no late progress of an upload that ended", () => {
    const now = failed(item(), 413, null, "payload_too_large");
    expect(step(now, { type: "progress", sent: 50 })).toBe(now);
  });
});

describe("refusals", () => {
  it.each([
    [0, "network_lost", "later"],
    [423, "upload_locked", "later"],
    [429, "too_many_at_once", "later"],
    [460, "checksum_mismatch", "later"],
    [500, "internal_error", "later"],
    [503, "overloaded", "later"],
    [502, "http_502", "later"],
    [409, "upload_conflict", "later"],
    [410, "upload_gone", "later"],
    [401, "unauthorized", "signed-out"],
    [507, "storage_full", "full"],
    [413, "quota_exceeded", "full"],
    [413, "payload_too_large", "final"],
    [409, "state_conflict", "final"],
    [403, "forbidden", "final"],
    [404, "not_found", "final"],
    [422, "request_invalid", "final"],
  ])("%i %s: %s", (status, code, meaning) => expect(meaningOf({ status, code })).toBe(meaning));

  it("pauses at least a second", () => expect(pauseMs(0, null)).toBe(1000));
});

describe("the queue", () => {
  it("starts the oldest first, photos beside a cube", () => {
    const items = [
      item({ id: "c", added: 3 }),
      item({ id: "b", added: 2 }),
      item({ id: "a", added: 1 }),
      item({ id: "cube", role: "cube", added: 0 }),
      item({ id: "raw", role: "cube", added: 0.5 }),
    ];
    expect(due(items, 0).map(({ id }) => id)).toEqual(["a", "b", "cube"]);
  });

  it("starts no more than there is room for", () => {
    const running = Array.from({ length: AT_ONCE.photo }, (_, n) => item({ id: `r${n}`, state: n ? "checking" : "sending" }));
    expect(due([...running, item({ id: "x" })], 0)).toEqual([]);
  });

  it("wakes those whose rest is over", () => {
    const items = [item({ id: "a", state: "resting", retryAt: 50 }), item({ id: "b", state: "resting", retryAt: 70 })];
    expect(due(items, 60).map(({ id }) => id)).toEqual(["a"]);
    expect(nextDue(items)).toBe(50);
    expect(nextDue([item()])).toBeNull();
  });
});
