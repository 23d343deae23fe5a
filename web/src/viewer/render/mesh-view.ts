/** The surface in the colours of the points. */
import { BufferAttribute, BufferGeometry, Mesh } from "three";
import type { Surface } from "../measure/ply";
import type { CloudView } from "./cloud-view";
import { surfaceMaterial } from "./materials";
import { nearestPoints } from "./nearest-points";

/** Farther from every point than this, a vertex has no colour of its own, mm. */
const MOST_MM = 0.5;
const UNSEEN = 120;

export class MeshView {
  readonly mesh: Mesh;
  private readonly material = surfaceMaterial();
  private readonly colours: BufferAttribute;
  private readonly points: Int32Array;

  constructor(
    private readonly view: CloudView,
    { positions, normals, triangles }: Surface,
  ) {
    this.points = nearestPoints(view.cloud.xyz, positions, MOST_MM);
    this.colours = new BufferAttribute(new Uint8Array((positions.length / 3) * 4).fill(UNSEEN), 4, true);
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(positions, 3));
    geometry.setAttribute("normal", new BufferAttribute(normals, 3));
    geometry.setAttribute("colour", this.colours);
    geometry.setIndex(new BufferAttribute(triangles, 1));
    this.mesh = new Mesh(geometry, this.material);
    this.mesh.frustumCulled = false;
    view.extras.add(this.mesh);
    this.take();
    view.onRecolour = () => this.take();
    view.onSection = () => this.cut();
    this.cut();
  }

  show(shown: boolean): void {
    this.mesh.visible = shown;
    this.view.draw();
  }

  private take(): void {
    const from = this.view.colours, to = this.colours.array as Uint8Array;
    this.points.forEach((point, vertex) => {
      if (point < 0) return;
      for (let c = 0; c < 3; c++) to[vertex * 4 + c] = from[point * 4 + c] as number;
    });
    this.colours.needsUpdate = true;
  }

  private cut(): void {
    (this.material.uniforms.plane?.value as { fromArray: (values: readonly number[]) => void }).fromArray(
      this.view.shownHalf ?? [0, 0, 0, 1],
    );
    this.view.draw();
  }
}
