/** What is seen of a cloud before its points have been read: one large point for each chunk, in the middle of its box. */
import { BufferAttribute, BufferGeometry, Points } from "three";
import { CHUNK, NOWHERE, type PointCloud } from "../data/point-cloud";
import { pointMaterial } from "./materials";

/** Size of such a point, in distances between the points of the cloud. */
const SPACINGS = 22;

export class CoarsePicture {
  readonly material = pointMaterial();
  readonly points: Points;
  private readonly centres: BufferAttribute;
  private readonly colours: BufferAttribute;

  constructor(private readonly cloud: PointCloud) {
    const { boxes, known } = cloud;
    const chunks = boxes.length / 6;
    const centres = Float32Array.from({ length: chunks * 3 }, (_, i) => {
      const at = Math.floor(i / 3) * 6 + (i % 3);
      return known[Math.floor(i / 3)] ? NOWHERE : ((boxes[at] ?? 0) + (boxes[at + 3] ?? 0)) / 2;
    });
    this.centres = new BufferAttribute(centres, 3);
    this.colours = new BufferAttribute(new Uint8Array(chunks * 4).fill(255), 4, true);
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", this.centres);
    geometry.setAttribute("colour", this.colours);
    this.points = new Points(geometry, this.material);
    this.points.visible = !cloud.complete;
  }

  /** Give way to points that have been read. */
  yieldTo(start: number, points: number): void {
    const first = Math.floor(start / CHUNK) * 3;
    (this.centres.array as Float32Array).fill(NOWHERE, first, Math.ceil((start + points) / CHUNK) * 3);
    this.centres.needsUpdate = true;
    this.points.visible = !this.cloud.complete;
  }

  /** Take colours, four bytes a point of the cloud: one from the middle of a chunk stands for it. */
  recolour(colours: Uint8Array): void {
    if (!this.points.visible) return;
    for (let chunk = 0; chunk < this.colours.count; chunk++) {
      const from = Math.min(chunk * CHUNK + CHUNK / 2, this.cloud.points - 1) * 4;
      (this.colours.array as Uint8Array).set(colours.subarray(from, from + 4), chunk * 4);
    }
    this.colours.needsUpdate = true;
  }

  /** Scale the points: distance between points of the cloud (mm), pixels a mm. */
  setScale(spacing: number, perMm: number): void {
    this.material.uniforms.size.value = SPACINGS * spacing;
    this.material.uniforms.perMm.value = perMm;
  }
}
