import { expect, it } from "vitest";
import { Matrix4, PerspectiveCamera } from "three";
import { PointCloud } from "../data/point-cloud";
import { project } from "../render/projection";
import { inOutline, pointsInOutline, thinned } from "./lasso";

it("knows inside from outside, also of a bent outline", () => {
  const bent = [[0, 0], [10, 0], [10, 10], [8, 10], [8, 2], [2, 2], [2, 10], [0, 10]] as const;
  expect(inOutline(bent, 1, 5)).toBe(true);
  expect(inOutline(bent, 9, 9)).toBe(true);
  expect(inOutline(bent, 5, 5)).toBe(false);
  expect(inOutline(bent, 11, 5)).toBe(false);
});

it("thins what a hand draws", () => {
  expect(thinned([[0, 0], [1, 0], [2, 0], [2.5, 0], [5, 0]])).toEqual([[0, 0], [2, 0], [5, 0]]);
});

it("takes the points that are seen, not those behind them", () => {
  const cloud = new PointCloud(512, 1);
  // Two planes, 6 mm apart, the second above the first and shifted by half.
  cloud.boxes = Float32Array.of(-8, -8, 0, 7, 7, 0, 0, -8, 6, 15, 7, 6);
  cloud.takePositions(0, Float32Array.from({ length: 1536 }, (_, i) => {
    const point = Math.floor(i / 3), upper = point >= 256;
    return [(point % 16) - 8 + (upper ? 8 : 0), (Math.floor(point / 16) % 16) - 8, upper ? 6 : 0][i % 3] ?? 0;
  }));
  const camera = new PerspectiveCamera(4, 1, 100, 2000);
  camera.position.set(0, 0, 1000);
  camera.updateMatrixWorld();
  const matrix = new Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse).elements;
  const p = { matrix, width: 300, height: 300 };
  const all = [[0, 0], [300, 0], [300, 300], [0, 300]] as const;
  const seen = pointsInOutline(cloud, p, all, null);
  const upper = seen.filter((i) => i >= 256);
  expect(upper).toHaveLength(256);
  // Of the lower plane, what does not lie under a point of the upper.
  expect(seen.filter((i) => i < 256).every((i) => cloud.place(i)[0] < 1)).toBe(true);
  expect(pointsInOutline(cloud, p, all, [0, 0, -1, 3]).length).toBe(256);
  const one = project(p, ...cloud.place(300));
  const [x, y] = [one?.x ?? 0, one?.y ?? 0];
  expect(pointsInOutline(cloud, p, [[x - 2, y - 2], [x + 2, y - 2], [x, y + 2]], null)).toEqual([300]);
});
