/** The three-dimensional view: draws a cloud when something has changed, and not otherwise. */
import {
  BufferAttribute,
  BufferGeometry,
  Color,
  Group,
  LinearSRGBColorSpace,
  Matrix4,
  PerspectiveCamera,
  Points,
  Scene,
  Vector3,
  WebGLRenderer,
  type Object3D,
  type WebGLRenderTarget,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import type { Tile } from "../figure/figure-layout";
import type { PointCloud } from "../data/point-cloud";
import { levelOrder } from "../data/shard-plan";
import { CoarsePicture } from "./coarse-picture";
import { DrawBudget } from "./draw-budget";
import { pointMaterial, ringMaterial } from "./materials";
import { pixelsPerMm, project, type Plane, type Projection } from "./projection";

export type CameraState = readonly [number, number, number, number, number, number];
export interface Ring {
  place: readonly [number, number, number];
  rgb: readonly [number, number, number];
}

const FIELD_OF_VIEW = 30;
const REST_MS = 180;
const LONGEST_REST_MS = 2000;

export class CloudView {
  readonly renderer: WebGLRenderer;
  readonly camera = new PerspectiveCamera(FIELD_OF_VIEW, 1, 1, 2000);
  readonly controls: OrbitControls;
  /** What parts of the page add: surface, cameras, lines. */
  readonly extras = new Group();
  /** Four bytes a point; call {@link recolour} after writing. */
  readonly colours: Uint8Array<ArrayBuffer>;
  /** Called after the camera has come to rest. */
  onRest: () => void = () => undefined;
  /** Called when colours have been written, and when the section has changed: what else is drawn follows. */
  onRecolour: () => void = () => undefined;
  onSection: () => void = () => undefined;
  /** Called with each frame drawn. */
  onFrame: () => void = () => undefined;
  private readonly scene = new Scene();
  private readonly material = pointMaterial();
  private readonly ringMaterial = ringMaterial();
  private readonly points: Points;
  private readonly coarse: CoarsePicture;
  private readonly rings = new Points(new BufferGeometry(), this.ringMaterial);
  private readonly budget: DrawBudget;
  private readonly spacing: number;
  private readonly watch: ResizeObserver;
  private frame = 0;
  private lastFrame = 0;
  private askedAt = 0;
  private drawMs = 0;
  private wholeMs = 0;
  private wasMoving = false;
  private moving = false;
  private rest: ReturnType<typeof setTimeout> | undefined;
  private handMoved = false;
  private section: Plane | null = null;
  private pointScale = 1;

  /** Throws where the browser has no WebGL 2. */
  constructor(
    readonly canvas: HTMLCanvasElement,
    readonly cloud: PointCloud,
  ) {
    this.renderer = new WebGLRenderer({ canvas, antialias: true, powerPreference: "high-performance" });
    // Colours are measured or chosen: they go to the screen as they are.
    this.renderer.outputColorSpace = LinearSRGBColorSpace;
    this.setSharpness(1);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = false;
    this.controls.addEventListener("change", () => this.moved());
    this.colours = new Uint8Array(cloud.points * 4).fill(255);
    this.spacing = cloud.spacing();
    this.budget = new DrawBudget(cloud.points);
    this.points = this.fullPoints();
    this.coarse = new CoarsePicture(cloud);
    for (const object of [this.points, this.coarse.points, this.rings]) object.frustumCulled = false;
    this.rings.renderOrder = 10;
    this.scene.add(this.points, this.coarse.points, this.extras, this.rings);
    this.watch = new ResizeObserver(() => this.resize());
    this.watch.observe(canvas);
    this.home();
  }

  dispose(): void {
    this.watch.disconnect();
    cancelAnimationFrame(this.frame);
    clearTimeout(this.rest);
    this.controls.dispose();
    this.scene.traverse((object) => disposeOf(object));
    this.renderer.dispose();
  }

  // ---- what is shown ----------------------------------------------------------------------------------

  /** Take positions that have been read: they replace the coarse picture there. */
  positionsRead(start: number, points: number): void {
    const position = attribute(this.points, "position");
    position.addUpdateRange(start * 3, points * 3);
    position.needsUpdate = true;
    this.coarse.yieldTo(start, points);
    this.drawCoarsely();
  }

  /** Show the colours that have been written. */
  recolour(): void {
    attribute(this.points, "colour").needsUpdate = true;
    this.coarse.recolour(this.colours);
    this.onRecolour();
    this.drawCoarsely();
  }

  setRings(rings: readonly Ring[]): void {
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(Float32Array.from(rings.flatMap((r) => [...r.place])), 3));
    geometry.setAttribute("colour", new BufferAttribute(Uint8Array.from(rings.flatMap((r) => [...r.rgb, 255])), 4, true));
    this.rings.geometry.dispose();
    this.rings.geometry = geometry;
    this.rings.visible = rings.length > 0;
    this.drawCoarsely();
  }

  /** Show half a space alone; null: all. */
  setSection(plane: Plane | null): void {
    this.section = plane;
    for (const material of [this.material, this.coarse.material]) material.uniforms.plane.value.fromArray(plane ?? [0, 0, 0, 1]);
    this.onSection();
    this.drawCoarsely();
  }

  get shownHalf(): Plane | null {
    return this.section;
  }

  setPointScale(scale: number): void {
    this.pointScale = scale;
    this.drawCoarsely();
  }

  showPoints(shown: boolean): void {
    this.points.visible = shown;
    this.draw();
  }

  setBackground(colour: string): void {
    this.scene.background = new Color().setStyle(colour, LinearSRGBColorSpace);
    this.draw();
  }

  // ---- camera -----------------------------------------------------------------------------------------

  get cameraState(): CameraState {
    const { position: p, target: t } = { position: this.camera.position, target: this.controls.target };
    return [p.x, p.y, p.z, t.x, t.y, t.z];
  }

  setCamera([x, y, z, tx, ty, tz]: CameraState): void {
    this.camera.position.set(x, y, z);
    this.controls.target.set(tx, ty, tz);
    this.controls.update();
    this.draw();
  }

  /** Look at the whole cloud from above and a little from the front. */
  home(from: readonly [number, number, number] = [0, -0.55, 1]): void {
    const { low, high } = this.cloud.bounds();
    const centre = low.map((value, i) => (value + (high[i] ?? 0)) / 2);
    const reach = Math.hypot(...low.map((value, i) => (high[i] ?? 0) - value)) / 2;
    const far = reach / Math.sin((FIELD_OF_VIEW * Math.PI) / 360) / Math.min(1, this.camera.aspect) / 1.12;
    const unit = far / Math.hypot(...from);
    const [x = 0, y = 0, z = 0] = centre;
    this.setCamera([x + from[0] * unit, y + from[1] * unit, z + from[2] * unit, x, y, z]);
  }

  /** Turn by angles (rad) around the target, or come nearer by a factor. For the keyboard. */
  orbit(around: number, up: number, nearer = 1): void {
    const offset = this.camera.position.clone().sub(this.controls.target);
    const polar = Math.min(Math.PI - 1e-3, Math.max(1e-3, Math.acos(offset.z / offset.length()) - up));
    const azimuth = Math.atan2(offset.y, offset.x) + around;
    const length = offset.length() / nearer;
    this.camera.position
      .set(Math.sin(polar) * Math.cos(azimuth), Math.sin(polar) * Math.sin(azimuth), Math.cos(polar))
      .multiplyScalar(length)
      .add(this.controls.target);
    this.controls.update();
    this.moved();
  }

  /** How places come onto the canvas, in CSS pixels. */
  projection(): Projection {
    this.placeCamera();
    const matrix = new Matrix4().multiplyMatrices(this.camera.projectionMatrix, this.camera.matrixWorldInverse);
    return { matrix: matrix.elements, width: this.canvas.clientWidth, height: this.canvas.clientHeight };
  }

  /** Where a point lies on the canvas, in CSS pixels; null behind the camera. */
  project(index: number): { x: number; y: number; depth: number } | null {
    return project(this.projection(), ...this.cloud.place(index));
  }

  // ---- drawing ----------------------------------------------------------------------------------------

  /** Draw with the next frame. */
  draw(): void {
    if (this.frame !== 0) return;
    this.askedAt = performance.now();
    this.frame = requestAnimationFrame((now) => this.drawNow(now));
  }

  /**
   * Draw a picture of another size, a tile at a time; `take` gets the pixels of each, four bytes each, rows from below.
   */
  drawTiles(
    background: string,
    width: number,
    height: number,
    tiles: readonly Tile[],
    take: (tile: Tile, pixels: Uint8Array) => void,
    target: (width: number, height: number) => WebGLRenderTarget,
  ): void {
    const shown = this.scene.background;
    this.setSharpness(1);
    this.scene.background = new Color().setStyle(background, LinearSRGBColorSpace);
    this.placeCamera();
    const perMm = (pixelsPerMm(this.projection()) * height) / this.canvas.clientHeight;
    const diameter = this.ringMaterial.uniforms.diameter as { value: number };
    const own = diameter.value;
    diameter.value = (own * height) / this.canvas.height;
    try {
      for (const tile of tiles) {
        const into = target(tile.width, tile.height);
        this.camera.setViewOffset(width, height, tile.x, tile.y, tile.width, tile.height);
        this.drawPoints(this.cloud.points, perMm);
        this.renderer.setRenderTarget(into);
        this.renderer.render(this.scene, this.camera);
        const pixels = new Uint8Array(tile.width * tile.height * 4);
        this.renderer.readRenderTargetPixels(into, 0, 0, tile.width, tile.height, pixels);
        into.dispose();
        take(tile, pixels);
      }
    } finally {
      diameter.value = own;
      this.renderer.setRenderTarget(null);
      this.camera.clearViewOffset();
      this.scene.background = shown;
      this.draw();
    }
  }

  private drawNow(now: number): void {
    this.frame = 0;
    // While points are read, each part of them is a frame.
    const moving = this.moving || !this.cloud.complete;
    const began = performance.now();
    // A GPU that is behind holds back either the frame or the calls that draw it.
    if (moving && this.wasMoving) this.budget.took(Math.max(began - this.askedAt, this.drawMs));
    this.wasMoving = moving;
    this.canvas.dataset.frameMs = String(Math.round(now - this.lastFrame));
    this.lastFrame = now;
    this.placeCamera();
    this.setSharpness(moving && this.budget.exhausted ? 0.5 : 1);
    this.drawPoints(moving ? this.budget.moving : this.cloud.points, pixelsPerMm(this.projection()) * this.renderer.getPixelRatio());
    this.renderer.render(this.scene, this.camera);
    this.drawMs = performance.now() - began;
    // How long a whole picture takes shows in when the next frame comes.
    if (!moving) requestAnimationFrame(() => (this.wholeMs = performance.now() - began));
    if (this.moving) this.awaitRest();
    this.onFrame();
  }

  /** Draw fewer pixels than the screen has, or all. */
  private setSharpness(share: number): void {
    const ratio = Math.min(devicePixelRatio, 2) * share;
    if (ratio !== this.renderer.getPixelRatio()) this.renderer.setPixelRatio(ratio);
  }

  private drawPoints(count: number, perMm: number): void {
    this.points.geometry.setDrawRange(0, count);
    // Fewer points are larger, so that the surface stays closed.
    const wider = Math.min(6, Math.sqrt(this.cloud.points / Math.max(1, count)));
    const { size, perMm: scale, least } = this.material.uniforms;
    size.value = this.spacing * 1.6 * wider * this.pointScale;
    least.value = Math.min(2, wider) * this.renderer.getPixelRatio() * 0.75;
    scale.value = perMm;
    this.coarse.setScale(this.spacing, perMm);
  }

  private moved(): void {
    this.drawCoarsely();
    this.handMoved = true;
  }

  /** Draw what the machine can in a frame, and all when nothing has come for a while. */
  private drawCoarsely(): void {
    this.moving = true;
    clearTimeout(this.rest);
    this.draw();
  }

  /** Called after a frame, not after the move that it shows: a slow frame must not look like rest. */
  private awaitRest(): void {
    clearTimeout(this.rest);
    this.rest = setTimeout(() => {
      this.moving = false;
      this.draw();
      if (this.handMoved) this.onRest();
      this.handMoved = false;
      // Where a whole picture holds up the page, it waits until a person does.
    }, Math.min(Math.max(REST_MS, 2 * this.wholeMs), LONGEST_REST_MS));
  }

  /** The nearest and farthest that is drawn hug the cloud: depth is as fine as it can be. */
  private placeCamera(): void {
    const { low, high } = this.cloud.bounds();
    const centre = new Vector3(...low).add(new Vector3(...high)).multiplyScalar(0.5);
    const reach = new Vector3(...high).distanceTo(centre) * 1.5 + 1;
    const distance = this.camera.position.distanceTo(centre);
    // Cameras of photos stand well outside of the cloud.
    this.camera.far = distance + Math.max(reach, this.extras.children.length > 0 ? 2000 : 0);
    this.camera.near = Math.max(0.5, distance - reach - (this.extras.children.length > 0 ? 500 : 0));
    this.camera.updateProjectionMatrix();
    this.camera.updateMatrixWorld();
  }

  private resize(): void {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (width === 0 || height === 0) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.draw();
  }

  private fullPoints(): Points {
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(this.cloud.xyz, 3));
    geometry.setAttribute("colour", new BufferAttribute(this.colours, 4, true));
    geometry.setIndex(new BufferAttribute(levelOrder(this.cloud.points), 1));
    return new Points(geometry, this.material);
  }
}

function attribute(points: Points, name: string): BufferAttribute {
  return points.geometry.getAttribute(name) as BufferAttribute;
}

function disposeOf(object: Object3D): void {
  const { geometry, material } = object as Partial<Points>;
  geometry?.dispose();
  if (material && !Array.isArray(material)) material.dispose();
}
