import { expect, it } from "vitest";
import { CHUNK, PointCloud } from "./point-cloud";

/** A plane of 32 x 32 points, 0.5 mm apart, in order of rows; four chunks. */
function plane(): PointCloud {
  const cloud = new PointCloud(1024, 3);
  const xyz = Float32Array.from({ length: 3072 }, (_, i) => {
    const point = Math.floor(i / 3);
    return [(point % 32) * 0.5, Math.floor(point / 32) * 0.5, 2][i % 3] ?? 0;
  });
  cloud.boxes = Float32Array.from({ length: 24 }, (_, i) => {
    const chunk = Math.floor(i / 6);
    return [0, chunk * 4, 2, 15.5, chunk * 4 + 3.5, 2][i % 6] ?? 0;
  });
  cloud.takePositions(0, xyz.subarray(0, 2 * CHUNK * 3));
  expect(cloud.complete).toBe(false);
  cloud.takePositions(2 * CHUNK, xyz.subarray(2 * CHUNK * 3));
  return cloud;
}

it("finds the points within a radius, borders included", () => {
  const cloud = plane();
  const truth = Array.from({ length: 1024 }, (_, i) => i).filter((i) => {
    const [x, y] = cloud.place(i);
    return Math.hypot(x - 8, y - 8) <= 1.5;
  });
  expect(cloud.within([8, 8, 2], 1.5)).toEqual(truth);
  expect(truth).toHaveLength(29);
  expect(cloud.within([8, 8, 4.1], 2)).toEqual([]);
});

it("knows its bounds and spacing", () => {
  const cloud = plane();
  expect(cloud.complete).toBe(true);
  expect(cloud.bounds()).toEqual({ low: [0, 0, 2], high: [15.5, 15.5, 2] });
  expect(cloud.spacing()).toBeCloseTo(0.46, 1);
});
