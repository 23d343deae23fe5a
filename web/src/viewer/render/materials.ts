/** Shaders of points and surface. Colours pass through as they are: no lighting and no tone mapping on measured values. */
import { GLSL3, RawShaderMaterial, Vector4, type IUniform } from "three";

interface Uniforms extends Record<string, IUniform> {
  /** Diameter of a point, mm. */
  size: IUniform<number>;
  /** Pixels that 1 mm has at distance 1. */
  perMm: IUniform<number>;
  least: IUniform<number>;
  /** Half-space that is shown: dot(xyz1, plane) >= 0. */
  plane: IUniform<Vector4>;
}

/** A material with its uniforms typed. */
export type CloudMaterial = RawShaderMaterial & { uniforms: Uniforms };

const VERTEX = `
      precision highp float;
      uniform mat4 modelViewMatrix, projectionMatrix;
      in vec3 position;`;
const FRAGMENT = `
      precision highp float;`;
const SECTION = "if (dot(vec4(position, 1.0), plane) < 0.0) gl_Position = vec4(0.0, 0.0, 2.0, 1.0);";

export function pointMaterial(): CloudMaterial {
  return new RawShaderMaterial({
    glslVersion: GLSL3,
    uniforms: { size: { value: 0.1 }, perMm: { value: 1000 }, least: { value: 1 }, plane: { value: new Vector4(0, 0, 0, 1) } },
    vertexShader: `${VERTEX}
      in vec4 colour;
      uniform float size, perMm, least;
      uniform vec4 plane;
      out vec3 shown;
      void main() {
        vec4 seen = modelViewMatrix * vec4(position, 1.0);
        gl_Position = projectionMatrix * seen;
        gl_PointSize = clamp(size * perMm / -seen.z, least, 64.0);
        shown = colour.rgb;
        ${SECTION}
      }`,
    fragmentShader: `${FRAGMENT}
      in vec3 shown;
      out vec4 pixel;
      void main() { pixel = vec4(shown, 1.0); }`,
  }) as CloudMaterial;
}

/** The surface in the colours of the nearest points, darker where it turns away, so that its form shows. */
export function surfaceMaterial(): RawShaderMaterial {
  return new RawShaderMaterial({
    glslVersion: GLSL3,
    uniforms: { plane: { value: new Vector4(0, 0, 0, 1) }, shade: { value: 1 } },
    side: 2,
    vertexShader: `${VERTEX}
      in vec4 colour;
      in vec3 normal;
      uniform mat3 normalMatrix;
      uniform vec4 plane;
      out vec3 shown, turned, towards;
      out float kept;
      void main() {
        vec4 seen = modelViewMatrix * vec4(position, 1.0);
        gl_Position = projectionMatrix * seen;
        shown = colour.rgb;
        turned = normalMatrix * normal;
        towards = -seen.xyz;
        kept = dot(vec4(position, 1.0), plane);
      }`,
    fragmentShader: `${FRAGMENT}
      in vec3 shown, turned, towards;
      in float kept;
      uniform float shade;
      out vec4 pixel;
      void main() {
        if (kept < 0.0) discard;
        float facing = abs(dot(normalize(turned), normalize(towards)));
        pixel = vec4(shown * mix(1.0, 0.35 + 0.65 * facing, shade), 1.0);
      }`,
  });
}

/** Rings of a fixed size in pixels, in front of everything: chosen points, the linked cursor. */
export function ringMaterial(): RawShaderMaterial {
  return new RawShaderMaterial({
    glslVersion: GLSL3,
    uniforms: { diameter: { value: 18 } },
    depthTest: false,
    transparent: true,
    vertexShader: `${VERTEX}
      in vec4 colour;
      uniform float diameter;
      out vec4 shown;
      void main() {
        gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
        gl_PointSize = diameter;
        shown = colour;
      }`,
    fragmentShader: `${FRAGMENT}
      in vec4 shown;
      uniform float diameter;
      out vec4 pixel;
      void main() {
        float r = length(gl_PointCoord - 0.5) * diameter;
        float edge = diameter * 0.5 - 1.0;
        float ring = smoothstep(edge - 5.0, edge - 4.0, r) - smoothstep(edge - 1.0, edge, r);
        float core = smoothstep(edge - 4.0, edge - 3.0, r) - smoothstep(edge - 2.0, edge - 1.0, r);
        if (ring <= 0.0) discard;
        pixel = vec4(mix(vec3(1.0), shown.rgb, core), ring);
      }`,
  });
}
