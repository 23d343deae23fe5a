import { describe, expect, it } from "vitest";
import { markerScale, outline, placed, RIM_DEG, wayTo, type Cell } from "./geometry";

const at = (azimuth_deg: number, elevation_deg: number) => ({ azimuth_deg, elevation_deg });

function near(point: { x: number; y: number }, x: number, y: number): void {
  expect(point.x).toBeCloseTo(x);
  expect(point.y).toBeCloseTo(y);
}

describe("the dome from above", () => {
  it("has the zenith in its middle and low directions on its rim", () => {
    near(placed(at(123, 90), 100), 0, 0);
    near(placed(at(0, RIM_DEG), 100), 100, 0);
    near(placed(at(90, RIM_DEG), 100), 0, -100);
    expect(placed(at(0, 3), 100).x).toBeCloseTo(100);
  });

  it("outlines a cell from the rim inward", () => {
    const cell = { azimuth_from_deg: 0, azimuth_to_deg: 90, elevation_from_deg: 20, elevation_to_deg: 90 } as Cell;
    expect(outline({ ...cell, elevation_to_deg: 55 }, 100)).toMatch(/^M100\.00 -?0\.00A100\.00 100\.00 0 0 0 0\.00 -100\.00L0\.00 -50\.00A50\.00 50\.00 0 0 1 50\.00 -?0\.00Z$/);
  });

  it("fits the markers", () => {
    expect(markerScale([{ id: 0, corners_mm: [[30, 40], [0, 0], [0, 0], [0, 0]] }], 100)).toBeCloseTo(0.6);
    expect(markerScale([], 100)).toBe(30);
  });
});

describe("the way to the next place", () => {
  it.each([
    [at(0, 35), at(30, 35), "right", "same"],
    [at(0, 35), at(-30, 35), "left", "same"],
    [at(170, 35), at(-160, 35), "right", "same"],
    [at(-170, 35), at(160, 35), "left", "same"],
    [at(0, 35), at(90, 55), "farRight", "higher"],
    [at(0, 55), at(-100, 35), "farLeft", "lower"],
    [at(0, 35), at(178, 35), "opposite", "same"],
    [at(0, 35), at(5, 55), "here", "higher"],
    [at(0, 35), at(5, 75), "here", "above"],
  ])("from %o to %o: %s, %s", (from, to, side, height) => expect(wayTo(from, to)).toEqual({ side, height }));
});
