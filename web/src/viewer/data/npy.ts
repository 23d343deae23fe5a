/** NumPy's file format, as far as the service speaks it: little-endian, C order. */

export type NpyValues = Float32Array | Float64Array | Uint8Array | Uint16Array | Int32Array | Uint32Array;

const KINDS: Record<string, new (buffer: ArrayBuffer, at: number, length: number) => NpyValues> = {
  "<f4": Float32Array,
  "<f8": Float64Array,
  "|u1": Uint8Array,
  "<u1": Uint8Array,
  "<u2": Uint16Array,
  "<i4": Int32Array,
  "<u4": Uint32Array,
};

/** Read an array. Throws where it is none. */
export function readNpy(buffer: ArrayBuffer): { shape: number[]; values: NpyValues } {
  const bytes = new Uint8Array(buffer);
  if (String.fromCharCode(...bytes.subarray(1, 6)) !== "NUMPY") throw new Error("This is no NumPy array.");
  const view = new DataView(buffer);
  const length = bytes[6] === 1 ? view.getUint16(8, true) : view.getUint32(8, true);
  const start = (bytes[6] === 1 ? 10 : 12) + length;
  const header = new TextDecoder("latin1").decode(bytes.subarray(start - length, start));
  const kind = KINDS[/'descr': '([^']+)'/.exec(header)?.[1] ?? ""];
  const shape = /'shape': \(([^)]*)\)/.exec(header)?.[1]?.split(",").filter((s) => s.trim() !== "").map(Number);
  if (!kind || !shape || header.includes("'fortran_order': True")) throw new Error(`This array is not read here: ${header}`);
  const count = shape.reduce((a, b) => a * b, 1);
  const aligned = start % 8 === 0 ? buffer : buffer.slice(start);
  return { shape, values: new kind(aligned, start % 8 === 0 ? start : 0, count) };
}

/** Write one-dimensional class values. */
export function writeNpy(values: Uint8Array | Uint16Array): Uint8Array<ArrayBuffer> {
  const descr = values instanceof Uint8Array ? "|u1" : "<u2";
  const text = `{'descr': '${descr}', 'fortran_order': False, 'shape': (${values.length},), }`;
  const length = Math.ceil((10 + text.length + 1) / 64) * 64;
  const out = new Uint8Array(length + values.byteLength);
  out.set([0x93, 0x4e, 0x55, 0x4d, 0x50, 0x59, 1, 0, (length - 10) & 255, (length - 10) >> 8]);
  out.set(new TextEncoder().encode(text.padEnd(length - 11) + "\n"), 10);
  out.set(new Uint8Array(values.buffer, values.byteOffset, values.byteLength), length);
  return out;
}
