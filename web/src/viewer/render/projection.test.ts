import { expect, it } from "vitest";
import { Matrix4, PerspectiveCamera, Vector3 } from "three";
import { PointCloud } from "../data/point-cloud";
import { pick, pixelsPerMm, project, type Projection } from "./projection";

function looking(from: Vector3): Projection {
  const camera = new PerspectiveCamera(40, 800 / 600, 1, 500);
  camera.up.set(0, 0, 1);
  camera.position.copy(from);
  camera.lookAt(0, 0, 0);
  camera.updateMatrixWorld();
  const matrix = new Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse);
  return { matrix: matrix.elements, width: 800, height: 600 };
}

/** Two planes of 16 x 16 points, 1 mm apart, at z = 0 and z = 5. */
function planes(): PointCloud {
  const cloud = new PointCloud(512, 1);
  const xyz = Float32Array.from({ length: 1536 }, (_, i) => {
    const point = Math.floor(i / 3);
    return [(point % 16) - 7.5, (Math.floor(point / 16) % 16) - 7.5, point < 256 ? 0 : 5][i % 3] ?? 0;
  });
  cloud.boxes = Float32Array.of(-7.5, -7.5, 0, 7.5, 7.5, 0, -7.5, -7.5, 5, 7.5, 7.5, 5);
  cloud.takePositions(0, xyz);
  return cloud;
}

it("projects as three.js does", () => {
  const p = looking(new Vector3(10, -30, 40));
  expect(project(p, 0, 0, 0)?.x).toBeCloseTo(400);
  expect(project(p, 0, 0, 0)?.y).toBeCloseTo(300);
  expect(project(p, 0, 0, 0)?.depth).toBeCloseTo(Math.hypot(10, 30, 40));
  expect(project(p, 20, -60, 80)).toBeNull();
  expect(pixelsPerMm(p)).toBeCloseTo(300 / Math.tan((20 * Math.PI) / 180));
});

it("picks the point nearest to the camera, and one below where a section takes it away", () => {
  const cloud = planes();
  const p = looking(new Vector3(0, -0.1, 80));
  for (const index of [256 + 17, 256 + 200]) {
    const at = project(p, ...cloud.place(index));
    expect(pick(cloud, p, at?.x ?? 0, at?.y ?? 0, 5, null)).toBe(index);
  }
  const below = project(p, ...cloud.place(40));
  expect(pick(cloud, p, below?.x ?? 0, below?.y ?? 0, 5, [0, 0, -1, 3])).toBe(40);
  expect(pick(cloud, p, 5, 5, 5, null)).toBeNull();
});
