import { expect, it } from "vitest";
import { PerspectiveCamera } from "three";
import { axesOf, scaleBar, tilesOf } from "./figure-layout";

it("covers a picture with tiles, once", () => {
  const tiles = tilesOf(5000, 3000, 2048);
  expect(tiles).toHaveLength(6);
  expect(tiles.reduce((sum, { width, height }) => sum + width * height, 0)).toBe(15_000_000);
  expect(tiles.at(-1)).toEqual({ x: 4096, y: 2048, width: 904, height: 952 });
});

it.each([[10, 1000, 20], [3.3, 1000, 50], [100, 999, 2], [0.4, 800, 500]])("chooses a round bar at %f px/mm", (perMm, width, mm) => {
  expect(scaleBar(perMm, width)).toEqual({ mm, pixels: mm * perMm });
});

it("turns the axes as the camera does", () => {
  const camera = new PerspectiveCamera();
  camera.up.set(0, 1, 0);
  camera.position.set(0, 0, 100);
  camera.lookAt(0, 0, 0);
  camera.updateMatrixWorld();
  const axes = axesOf(camera.matrixWorldInverse.elements);
  expect(axes.at(-1)?.name).toBe("z");
  expect(axes.find(({ name }) => name === "x")?.right).toBeCloseTo(1);
  expect(axes.find(({ name }) => name === "y")?.down).toBeCloseTo(-1);
});
