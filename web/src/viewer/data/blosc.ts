/**
 * Decodes the Blosc frames of a cloud's chunks: format 1, LZ4, with bytes or bits shuffled.
 *
 * numcodecs has this in WebAssembly, 600 kB, but makes functions of texts at run time (embind), which the pages'
 * content-security policy forbids.
 */

const HEADER = 16;
const BYTE_SHUFFLE = 1, STORED = 2, BIT_SHUFFLE = 4, NOT_SPLIT = 16;
const LZ4 = 1;
/** A block is split into a stream for each byte of an element where these allow it (c-blosc's own limits). */
const MOST_SPLITS = 16, LEAST_SPLIT = 128;

/** Return the decoded bytes of a frame. Throws where it is damaged or of another kind. */
export function decodeBlosc(frame: Uint8Array): Uint8Array<ArrayBuffer> {
  const view = new DataView(frame.buffer, frame.byteOffset, frame.byteLength);
  const flags = view.getUint8(2), typeSize = view.getUint8(3);
  const size = view.getUint32(4, true), blockSize = view.getUint32(8, true);
  const out = new Uint8Array(size);
  if (flags & STORED) {
    out.set(frame.subarray(HEADER, HEADER + size));
    return out;
  }
  if (flags >> 5 !== LZ4) throw new Error(`a Blosc frame of the compressor ${flags >> 5}, which no cloud has`);
  const shuffled = (flags & (BYTE_SHUFFLE | BIT_SHUFFLE)) !== 0;
  const block = new Uint8Array(blockSize);
  for (let start = 0, number = 0; start < size; start += blockSize, number++) {
    const length = Math.min(blockSize, size - start);
    const split = !(flags & NOT_SPLIT) && typeSize <= MOST_SPLITS && blockSize / typeSize >= LEAST_SPLIT && length === blockSize;
    const into = out.subarray(start, start + length);
    const target = shuffled ? block.subarray(0, length) : into;
    decodeStreams(frame, view, view.getUint32(HEADER + 4 * number, true), target, split ? typeSize : 1);
    if (!shuffled) continue;
    if (flags & BIT_SHUFFLE) unshuffleBits(target, into, typeSize);
    else unshuffleBytes(target, into, typeSize);
  }
  return out;
}

function decodeStreams(frame: Uint8Array, view: DataView, at: number, out: Uint8Array, count: number): void {
  const length = out.length / count;
  for (let i = 0; i < count; i++) {
    const packed = view.getInt32(at, true);
    at += 4;
    if (packed < 0 || at + packed > frame.length) throw new Error("a Blosc frame that is cut off");
    const part = out.subarray(i * length, (i + 1) * length);
    if (packed === length) part.set(frame.subarray(at, at + packed));
    else decodeLz4(frame, at, at + packed, part);
    at += packed;
  }
}

/** Decode an LZ4 block. */
function decodeLz4(from: Uint8Array, at: number, end: number, out: Uint8Array): void {
  let to = 0;
  while (at < end) {
    const token = from[at++] as number;
    let literals = token >> 4;
    if (literals === 15) {
      let more: number;
      do literals += more = from[at++] as number;
      while (more === 255);
    }
    if (at + literals > end || to + literals > out.length) throw new Error("damaged LZ4 data");
    if (literals > 32) out.set(from.subarray(at, at + literals), to);
    else for (let i = 0; i < literals; i++) out[to + i] = from[at + i] as number;
    at += literals;
    to += literals;
    if (at >= end) break;
    const back = (from[at] as number) | ((from[at + 1] as number) << 8);
    at += 2;
    let length = (token & 15) + 4;
    if (length === 19) {
      let more: number;
      do length += more = from[at++] as number;
      while (more === 255);
    }
    let source = to - back;
    if (back === 0 || source < 0 || to + length > out.length) throw new Error("damaged LZ4 data");
    if (back >= length) out.copyWithin(to, source, source + length);
    else if (back === 1) out.fill(out[source] as number, to, to + length);
    else for (let i = 0; i < length; i++) out[to + i] = out[source++] as number;
    to += length;
  }
  if (to !== out.length) throw new Error("LZ4 data of another length");
}

function unshuffleBytes(from: Uint8Array, out: Uint8Array, typeSize: number): void {
  const count = Math.floor(from.length / typeSize);
  for (let j = 0, source = 0; j < typeSize; j++) {
    for (let to = j, i = 0; i < count; i++, to += typeSize) out[to] = from[source++] as number;
  }
  out.set(from.subarray(count * typeSize), count * typeSize);
}

/** Row 8 j + b holds bit b of byte j of all elements, eight to a byte; c-blosc leaves counts that are no eights as they are. */
function unshuffleBits(from: Uint8Array, out: Uint8Array, typeSize: number): void {
  const count = Math.floor(from.length / typeSize);
  if (count % 8 !== 0) {
    out.set(from);
    return;
  }
  const row = count / 8;
  for (let j = 0; j < typeSize; j++) {
    const base = 8 * j * row;
    for (let g = 0, to = j; g < row; g++) {
      let at = base + g;
      // The transpose of 8 x 8 bits in two words (Hacker's Delight, 7-3).
      let low = from[at] as number;
      low |= (from[(at += row)] as number) << 8;
      low |= (from[(at += row)] as number) << 16;
      low |= (from[(at += row)] as number) << 24;
      let high = from[(at += row)] as number;
      high |= (from[(at += row)] as number) << 8;
      high |= (from[(at += row)] as number) << 16;
      high |= (from[at + row] as number) << 24;
      let t = (low ^ (low >>> 7)) & 0x00aa00aa;
      low ^= t ^ (t << 7);
      t = (high ^ (high >>> 7)) & 0x00aa00aa;
      high ^= t ^ (t << 7);
      t = (low ^ (low >>> 14)) & 0x0000cccc;
      low ^= t ^ (t << 14);
      t = (high ^ (high >>> 14)) & 0x0000cccc;
      high ^= t ^ (t << 14);
      const first = (low & 0x0f0f0f0f) | ((high & 0x0f0f0f0f) << 4);
      const second = ((low >>> 4) & 0x0f0f0f0f) | (high & 0xf0f0f0f0);
      for (let shift = 0; shift < 32; shift += 8, to += typeSize) out[to] = first >>> shift;
      for (let shift = 0; shift < 32; shift += 8, to += typeSize) out[to] = second >>> shift;
    }
  }
  out.set(from.subarray(count * typeSize), count * typeSize);
}

/** The codec as zarrita's registry takes it. */
export const bloscCodec = {
  fromConfig: () => ({
    kind: "bytes_to_bytes" as const,
    encode: (): never => {
      throw new Error("clouds are not written here");
    },
    decode: decodeBlosc,
  }),
};
