import { expect, it } from "vitest";
import { SurfaceGraph } from "./geodesic";
import { angleAt, deviationOfLength, lengthOf, outlineArea, type Place } from "./geometry";
import { readPly, type Surface } from "./ply";

it("measures lengths, angles and areas", () => {
  expect(lengthOf([[0, 0, 0], [3, 4, 0], [3, 4, 2]])).toBeCloseTo(7);
  expect(angleAt([1, 0, 0], [0, 0, 0], [0, 0, 5])).toBeCloseTo(90);
  expect(angleAt([1, 0, 0], [0, 0, 0], [0, 0, 0])).toBeNaN();
  // A square of 4 mm, tilted by 45 degrees.
  const h = Math.SQRT1_2 * 4;
  expect(outlineArea([[0, 0, 0], [4, 0, 0], [4, h, h], [0, h, h]])).toBeCloseTo(16);
});

it("states the deviation of a length", () => {
  expect(deviationOfLength([[0, 0, 0], [10, 0, 0]], [0.3, 0.4])).toBeCloseTo(0.5);
  // A place in the middle of a straight line moves nothing to first order.
  expect(deviationOfLength([[0, 0, 0], [5, 0, 0], [10, 0, 0]], [0, 9, 0])).toBeCloseTo(0);
});

/** A sheet of n x n places bent around a cylinder of radius 10 mm, triangles of alternating slant. */
function sheet(n: number, arc: number, bent = true): { surface: Surface; at: (row: number, column: number) => number } {
  const places: Place[] = [];
  for (let row = 0; row < n; row++) {
    for (let column = 0; column < n; column++) {
      const angle = (column / (n - 1)) * arc, y = (row / (n - 1)) * 10;
      places.push(bent ? [10 * Math.sin(angle), y, 10 * Math.cos(angle)] : [10 * angle, y, 0]);
    }
  }
  const triangles: number[] = [];
  for (let row = 0; row < n - 1; row++) {
    for (let column = 0; column < n - 1; column++) {
      const a = row * n + column;
      if ((row + column) % 2) triangles.push(a, a + 1, a + n, a + 1, a + n + 1, a + n);
      else triangles.push(a, a + 1, a + n + 1, a, a + n + 1, a + n);
    }
  }
  const surface = { positions: Float32Array.from(places.flat()), normals: new Float32Array(places.length * 3), triangles: Uint32Array.from(triangles) };
  return { surface, at: (row, column) => row * n + column };
}

it.each([true, false])("finds the way along a surface, bent: %s", (bent) => {
  const { surface, at } = sheet(101, 2, bent);
  const graph = new SurfaceGraph(surface);
  const a = graph.place(at(0, 0));
  for (const [row, column] of [[0, 100], [100, 100], [40, 90], [100, 30]] as const) {
    // On a cylinder, as on a plane, the way is straight on the unrolled sheet.
    const truth = Math.hypot((column / 100) * 20, (row / 100) * 10);
    const way = graph.way(a, graph.place(at(row, column)));
    expect(way?.upper).toBeGreaterThanOrEqual(truth * 0.999);
    expect((way?.length ?? 0) / truth).toBeGreaterThan(0.985);
    expect((way?.length ?? 0) / truth).toBeLessThan(1.09);
  }
});

it("finds no way between parts that do not touch", () => {
  const positions = Float32Array.of(0, 0, 0, 1, 0, 0, 0, 1, 0, 9, 0, 0, 10, 0, 0, 9, 1, 0);
  const graph = new SurfaceGraph({ positions, normals: new Float32Array(18), triangles: Uint32Array.of(0, 1, 2, 3, 4, 5) });
  expect(graph.way([0, 0, 0], [10, 0, 0])).toBeNull();
  expect(graph.way([0, 0, 0], [1, 0, 0])?.length).toBeCloseTo(1);
});

it("reads a surface, and refuses what is none", () => {
  const head = "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n" +
    "property uchar red\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n";
  const body = new ArrayBuffer(3 * 13 + 13);
  const view = new DataView(body);
  [[0, 0, 0], [1, 0, 0], [0, 1, 2.5]].forEach((p, i) => p.forEach((v, c) => view.setFloat32(i * 13 + c * 4, v, true)));
  view.setUint8(39, 3);
  [0, 1, 2].forEach((v, i) => view.setInt32(40 + i * 4, v, true));
  const file = Uint8Array.from([...new TextEncoder().encode(head), ...new Uint8Array(body)]);
  const surface = readPly(file.buffer);
  expect([...surface.positions]).toEqual([0, 0, 0, 1, 0, 0, 0, 1, 2.5]);
  expect([...surface.triangles]).toEqual([0, 1, 2]);
  expect(() => readPly(file.slice(0, -5).buffer)).toThrow("cut off");
  expect(() => readPly(new ArrayBuffer(10))).toThrow("no surface");
});
