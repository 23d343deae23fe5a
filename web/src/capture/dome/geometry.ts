/** The dome of viewpoints drawn from above: the middle is straight above the specimen, the rim is low beside it. */
import type { Schemas } from "../../api/client";

type Placed = Schemas["MarkerPlace"];
/** As the client types it, which makes arrays of the contract's pairs. */
export type Viewpoints = Omit<Schemas["Viewpoints"], "markers"> & {
  markers: readonly (Omit<Placed, "corners_mm"> & { corners_mm: readonly (readonly number[])[] })[];
};
export type Cell = Schemas["DomeCell"];
export interface Direction {
  azimuth_deg: number;
  elevation_deg: number;
}

/** The elevation at the rim. */
export const RIM_DEG = 20;

const radians = (degrees: number): number => (degrees * Math.PI) / 180;

/** Where a direction is drawn in a circle of `radius` about the origin; y downward, as in SVG. Lower ones lie on the rim. */
export function placed({ azimuth_deg, elevation_deg }: Direction, radius: number): { x: number; y: number } {
  const r = (radius * (90 - Math.max(elevation_deg, RIM_DEG))) / (90 - RIM_DEG);
  return { x: r * Math.cos(radians(azimuth_deg)), y: -r * Math.sin(radians(azimuth_deg)) };
}

/** The outline of a cell, as a path of SVG. */
export function outline(cell: Cell, radius: number): string {
  const corner = (azimuth_deg: number, elevation_deg: number): string => {
    const { x, y } = placed({ azimuth_deg, elevation_deg }, radius);
    return `${x.toFixed(2)} ${y.toFixed(2)}`;
  };
  const { azimuth_from_deg: from, azimuth_to_deg: to, elevation_from_deg: low, elevation_to_deg: high } = cell;
  const reach = (elevation: number): string => ((radius * (90 - elevation)) / (90 - RIM_DEG)).toFixed(2);
  // Azimuths grow counterclockwise, which SVG calls sweep 0.
  return `M${corner(from, low)}A${reach(low)} ${reach(low)} 0 0 0 ${corner(to, low)}L${corner(to, high)}A${reach(high)} ${reach(high)} 0 0 1 ${corner(from, high)}Z`;
}

export interface Way {
  side: "here" | "right" | "left" | "farRight" | "farLeft" | "opposite";
  height: "same" | "higher" | "lower" | "above";
}

/** The way from where somebody stands, facing the specimen, to another place of the dome. */
export function wayTo(from: Direction, to: Direction): Way {
  // To the right of one who faces the middle, azimuths grow.
  const turn = ((((to.azimuth_deg - from.azimuth_deg) % 360) + 540) % 360) - 180;
  const far = Math.abs(turn);
  const side = far < 10 ? "here" : far > 140 ? "opposite" : far > 60 ? (turn > 0 ? "farRight" : "farLeft") : turn > 0 ? "right" : "left";
  const rise = to.elevation_deg - from.elevation_deg;
  const height = to.elevation_deg >= 70 ? "above" : rise > 8 ? "higher" : rise < -8 ? "lower" : "same";
  return { side, height };
}

/** How markers in mm are drawn in the middle of the dome: a scale that lets the farthest reach a third of the radius. */
export function markerScale(markers: Viewpoints["markers"], radius: number): number {
  const reach = Math.max(...markers.flatMap(({ corners_mm }) => corners_mm.map((corner) => Math.hypot(corner[0] ?? 0, corner[1] ?? 0))), 1);
  return (0.3 * radius) / reach;
}
