/** Reads the surface of a result: binary little-endian PLY of vertices and triangles. */

export interface Surface {
  /** mm, (vertices, 3). */
  positions: Float32Array<ArrayBuffer>;
  normals: Float32Array<ArrayBuffer>;
  /** (triangles, 3). */
  triangles: Uint32Array<ArrayBuffer>;
}

const SIZES: Record<string, number> = { char: 1, uchar: 1, short: 2, ushort: 2, int: 4, uint: 4, float: 4, double: 8 };

/** Throws where the file is another kind of PLY, or is cut off. */
export function readPly(buffer: ArrayBuffer): Surface {
  const head = new TextDecoder("latin1").decode(buffer.slice(0, 4096));
  const end = head.indexOf("end_header\n");
  if (!head.startsWith("ply") || end < 0 || !head.includes("format binary_little_endian")) throw new Error("This is no surface.");
  const vertexCount = Number(/element vertex (\d+)/.exec(head)?.[1] ?? 0);
  const faceCount = Number(/element face (\d+)/.exec(head)?.[1] ?? 0);
  const vertexPart = head.slice(head.indexOf("element vertex"), head.indexOf("element face"));
  const offsets = new Map<string, number>();
  let stride = 0;
  for (const [, type = "", name = ""] of vertexPart.matchAll(/property (\w+) (\w+)/g)) {
    offsets.set(name, stride);
    stride += SIZES[type] ?? 0;
  }
  const view = new DataView(buffer);
  const start = end + "end_header\n".length;
  const faces = start + vertexCount * stride;
  if (faces + faceCount * 13 > buffer.byteLength) throw new Error("The surface is cut off.");
  const column = (names: readonly string[]): Float32Array<ArrayBuffer> => {
    const out = new Float32Array(vertexCount * 3);
    const at = names.map((name) => offsets.get(name));
    for (let i = 0; i < vertexCount; i++) {
      for (let c = 0; c < 3; c++) {
        const offset = at[c];
        if (offset !== undefined) out[i * 3 + c] = view.getFloat32(start + i * stride + offset, true);
      }
    }
    return out;
  };
  const triangles = new Uint32Array(faceCount * 3);
  for (let i = 0; i < faceCount; i++) {
    if (view.getUint8(faces + i * 13) !== 3) throw new Error("The surface is not made of triangles.");
    for (let c = 0; c < 3; c++) triangles[i * 3 + c] = view.getUint32(faces + i * 13 + 1 + c * 4, true);
  }
  return { positions: column(["x", "y", "z"]), normals: column(["nx", "ny", "nz"]), triangles };
}
