import { describe, expect, it } from "vitest";
import { rounded, stagesOf } from "./time-left";

describe("a running job", () => {
  it.each([
    [1, 5],
    [12, 15],
    [61, 90],
    [310, 360],
  ])("%i s is about %i s", (seconds, about) => expect(rounded(seconds)).toBe(about));

  it("tells the stages", () => {
    expect(stagesOf({ state: "running", stage: "adjust" }).map(([, at]) => at)).toEqual(["done", "now", "ahead", "ahead"]);
    expect(stagesOf({ state: "failed", stage: "register" }).map(([, at]) => at)).toEqual(["done", "done", "done", "failed"]);
    expect(stagesOf({ state: "queued", stage: null }).map(([, at]) => at)).toEqual(["ahead", "ahead", "ahead", "ahead"]);
    expect(stagesOf({ state: "succeeded", stage: "register" }).map(([, at]) => at)).toEqual(["done", "done", "done", "done"]);
  });
});
