/** Lines in the picture: measured ways, cameras, markers. */
import { BufferAttribute, BufferGeometry, GLSL3, Group, LineSegments, RawShaderMaterial, Vector3 } from "three";

export type Segment = readonly [readonly [number, number, number], readonly [number, number, number]];

/** Make lines between pairs of places; `above` draws them in front of everything. */
export function lineSegments(segments: readonly Segment[], rgb: readonly [number, number, number], above: boolean): LineSegments {
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(Float32Array.from(segments.flat(2)), 3));
  const material = new RawShaderMaterial({
    glslVersion: GLSL3,
    depthTest: !above,
    uniforms: { colour: { value: new Vector3(...rgb).divideScalar(255) } },
    vertexShader: `
      precision highp float;
      uniform mat4 modelViewMatrix, projectionMatrix;
      in vec3 position;
      void main() { gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); }`,
    fragmentShader: `
      precision highp float;
      uniform vec3 colour;
      out vec4 pixel;
      void main() { pixel = vec4(colour, 1.0); }`,
  });
  const lines = new LineSegments(geometry, material);
  lines.frustumCulled = false;
  lines.renderOrder = above ? 9 : 0;
  return lines;
}

/** The pieces of a line through places. */
export function pieces(line: readonly (readonly [number, number, number])[], closed = false): Segment[] {
  const found = line.slice(1).map((place, i): Segment => [line[i] ?? place, place]);
  const first = line[0], last = line.at(-1);
  if (closed && line.length > 2 && first && last) found.push([last, first]);
  return found;
}

/** Take away what a group holds, and its memory on the GPU. */
export function emptied(group: Group): Group {
  for (const child of [...group.children]) {
    const { geometry, material } = child as Partial<LineSegments>;
    geometry?.dispose();
    if (material && !Array.isArray(material)) material.dispose();
    group.remove(child);
  }
  return group;
}
