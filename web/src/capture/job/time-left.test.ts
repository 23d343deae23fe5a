import { describe, expect, it } from "vitest";
import { done, rounded, secondsLeft, stagesOf } from "./time-left";

describe("how far a job is", () => {
  it("grows with stages and within them", () => {
    const steps = [done(null, 0.5), done("reconstruct", 0), done("reconstruct", 0.5), done("adjust", 0), done("render", 0.5), done("register", 1)];
    expect(steps).toEqual([...steps].sort((a, b) => a - b));
    expect(steps[0]).toBe(0);
    expect(steps.at(-1)).toBeCloseTo(1);
  });

  it("does not guess at the start", () => {
    expect(secondsLeft(0.01, 10)).toBeNull();
    expect(secondsLeft(0.5, 30)).toBe(30);
    expect(secondsLeft(1, 30)).toBe(0);
  });

  it.each([
    [1, 5],
    [12, 15],
    [61, 90],
    [310, 360],
  ])("%i s is about %i s", (seconds, about) => expect(rounded(seconds)).toBe(about));

  it("tells the stages", () => {
    expect(stagesOf({ state: "running", stage: "adjust" }).map(([, at]) => at)).toEqual(["done", "now", "ahead", "ahead"]);
    expect(stagesOf({ state: "queued", stage: null }).map(([, at]) => at)).toEqual(["ahead", "ahead", "ahead", "ahead"]);
    expect(stagesOf({ state: "succeeded", stage: "register" }).map(([, at]) => at)).toEqual(["done", "done", "done", "done"]);
  });
});
