import { describe, expect, it } from "vitest";
import { remedyOf } from "./remedy";

describe("after a failed job", () => {
  it.each([
    ["no_markers_found", "photos"],
    ["result_insufficient", "photos"],
    ["markers_missing_in_cube", "cube"],
    ["cube_truncated", "cube"],
    ["worker_crashed", null],
    ["cancelled", null],
  ])("%s: %s", (code, remedy) => expect(remedyOf(code)).toBe(remedy));
});
