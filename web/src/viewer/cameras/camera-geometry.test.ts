import { expect, it } from "vitest";
import { centreOf, directionOf, distanceToPlane, frustum, placeOf, type PhotoCamera } from "./camera-geometry";

/** 100 mm above the origin, looking down: x right, y towards -y of the world. */
const above: PhotoCamera = {
  name: "a.jpg", width: 200, height: 100,
  cam_from_world: [[1, 0, 0, -5], [0, -1, 0, 0], [0, 0, -1, 100]],
  camera: { focal_px: [400, 400], principal_point_px: [100, 50] },
};

it("knows where a camera stands and looks, and what its pixels show", () => {
  expect(centreOf(above).map((v) => v + 0)).toEqual([5, 0, 100]);
  expect(directionOf(above).map((v) => v + 0)).toEqual([0, 0, -1]);
  expect(distanceToPlane(above)).toBeCloseTo(100);
  const place = placeOf(above, 140, 50, 100);
  [15, 0, 0].forEach((v, i) => expect(place[i]).toBeCloseTo(v));
  const lower = placeOf(above, 100, 90, 100);
  [5, -10, 0].forEach((v, i) => expect(lower[i]).toBeCloseTo(v));
  expect(frustum(above, 10)).toHaveLength(8);
});
