/** Cameras of photos in the marker frame. No DOM. */
import { dot, plus, scaled, type Place } from "../measure/geometry";
import type { Segment } from "../render/lines";

export interface PhotoCamera {
  name: string;
  width: number;
  height: number;
  /** 3 x 4: x right, y down, z forward. */
  cam_from_world: number[][];
  camera: { focal_px: number[]; principal_point_px: number[] };
}

const row = (camera: PhotoCamera, i: number): Place => {
  const [x = 0, y = 0, z = 0] = camera.cam_from_world[i] ?? [];
  return [x, y, z];
};

/** Where the camera stands, mm: -R^T t. */
export function centreOf(camera: PhotoCamera): Place {
  return [0, 1, 2].reduce<Place>((sum, i) => plus(sum, scaled(row(camera, i), -(camera.cam_from_world[i]?.[3] ?? 0))), [0, 0, 0]);
}

/** Where the camera looks: the unit vector of its z axis. */
export function directionOf(camera: PhotoCamera): Place {
  return row(camera, 2);
}

/** The place that a pixel shows at a depth, mm; lens distortion is left out. */
export function placeOf(camera: PhotoCamera, column: number, line: number, depth: number): Place {
  const { focal_px: f, principal_point_px: c } = camera.camera;
  const own: Place = [((column - (c[0] ?? 0)) / (f[0] ?? 1)) * depth, ((line - (c[1] ?? 0)) / (f[1] ?? 1)) * depth, depth];
  const turned = [0, 1, 2].reduce<Place>((sum, i) => plus(sum, scaled(row(camera, i), own[i] ?? 0)), [0, 0, 0]);
  return plus(centreOf(camera), turned);
}

/** A pyramid that stands for the camera, `depth` mm long. */
export function frustum(camera: PhotoCamera, depth: number): Segment[] {
  const centre = centreOf(camera);
  const corners = [[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]].map(([x = 0, y = 0]) =>
    placeOf(camera, x, y, depth),
  );
  return corners.flatMap((corner, i): Segment[] => [
    [centre, corner],
    [corner, corners[(i + 1) % 4] ?? corner],
  ]);
}

/** Distance along a camera's axis to the plane of the markers; 100 where it does not look at it. */
export function distanceToPlane(camera: PhotoCamera): number {
  const centre = centreOf(camera), direction = directionOf(camera);
  const distance = -centre[2] / dot(direction, [0, 0, 1]);
  return Number.isFinite(distance) && distance > 0 ? distance : 100;
}
