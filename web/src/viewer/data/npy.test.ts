import { expect, it } from "vitest";
import { readNpy, writeNpy } from "./npy";
import { bandOfSample, sampleStep } from "./sample";

it.each([Uint8Array.of(0, 1, 255), Uint16Array.of(0, 300, 65535)])("reads what it writes", (values) => {
  expect(readNpy(writeNpy(values).buffer)).toEqual({ shape: [3], values });
});

it("reads an array as NumPy 1.0 writes it", () => {
  // np.save of np.arange(2, dtype="<f4").reshape(2, 1)
  const head = "\x93NUMPY\x01\x00\x76\x00{'descr': '<f4', 'fortran_order': False, 'shape': (2, 1), }".padEnd(127) + "\n";
  const bytes = Uint8Array.from([...Array.from(head, (c) => c.charCodeAt(0)), 0, 0, 0, 0, 0, 0, 0x80, 0x3f]);
  expect(readNpy(bytes.buffer)).toEqual({ shape: [2, 1], values: Float32Array.of(0, 1) });
});

it("refuses what is none", () => {
  expect(() => readNpy(new TextEncoder().encode("<!doctype html> and more").buffer)).toThrow("no NumPy");
});

it("spreads a sample over its neighbours", () => {
  const sample = { step: 2, count: 2, spectra: Float32Array.of(1, 10, 2, 20) };
  expect([...bandOfSample(sample, 1, 2, 3)]).toEqual([10, 10, 20]);
});

it("samples as many spectra as a page takes", () => {
  expect(sampleStep(179_008, 16)).toBe(16);
  expect(sampleStep(1_310_720, 290)).toBe(32);
});
