import { expect, it } from "vitest";
import { nearestPoints } from "./nearest-points";

it("finds the nearest points, as trying all does", () => {
  let seed = 7;
  const random = (): number => (seed = (seed * 16807) % 2147483647) / 2147483647;
  const xyz = Float32Array.from({ length: 900 }, () => random() * 4 - 2);
  const places = Float32Array.from({ length: 300 }, () => random() * 4 - 2);
  const found = nearestPoints(xyz, places, 0.6);
  for (let n = 0; n < 100; n++) {
    const distances = Array.from({ length: 300 }, (_, p) =>
      Math.hypot(...[0, 1, 2].map((c) => (xyz[p * 3 + c] ?? 0) - (places[n * 3 + c] ?? 0))));
    const least = Math.min(...distances);
    expect(found[n]).toBe(least <= 0.6 ? distances.indexOf(least) : -1);
  }
  expect(found.filter((p) => p >= 0).length).toBeGreaterThan(50);
});
