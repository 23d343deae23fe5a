import { describe, expect, it } from "vitest";
import { doneShare, secondsLeft } from "./time-left";

describe("doneShare", () => {
  it("grows from stage to stage and never leaves 0 to 1", () => {
    const shares = (["reconstruct", "adjust", "render", "register"] as const).flatMap((stage) => [0, 0.5, 1, 7].map((p) => doneShare(stage, p)));
    expect([...shares].sort((a, b) => a - b)).toEqual(shares);
    expect(shares[0]).toBe(0);
    expect(shares.at(-1)).toBeCloseTo(1);
    expect(doneShare(null, 0.5)).toBe(0);
  });
});

describe("secondsLeft", () => {
  const job = { stage: "adjust", progress: 0.5, started_at: "2026-01-01T00:00:00Z" } as const;
  const start = Date.parse(job.started_at);
  it("follows the pace so far", () => {
    expect(secondsLeft(job, start + 11_000)).toBe(9);
    expect(secondsLeft(job, start + 110_000)).toBe(90);
  });
  it("says nothing while there is nothing to go by", () => {
    expect(secondsLeft({ ...job, started_at: null }, start)).toBeNull();
    expect(secondsLeft({ ...job, stage: "reconstruct", progress: 0.1 }, start + 5_000)).toBeNull();
    expect(secondsLeft(job, start + 500)).toBeNull();
  });
});
