import { describe, expect, it } from "vitest";
import { quoted, readReference, writeCurves } from "./csv";
import { meanAndDeviation, resampled, spectralAngle } from "./statistics";

describe("statistics", () => {
  it("finds mean and deviation of each band, without what is no number", () => {
    const { mean, sd, n } = meanAndDeviation(Float32Array.of(1, 10, 2, NaN, 3, 14), 2);
    expect(n).toBe(3);
    expect([...mean]).toEqual([2, 12]);
    expect(sd[0]).toBeCloseTo(1);
    expect(sd[1]).toBeCloseTo(Math.SQRT2 * 2);
    expect([...meanAndDeviation(Float32Array.of(5), 1).sd]).toEqual([0]);
  });

  it("measures the angle between spectra, whatever their brightness", () => {
    expect(spectralAngle([1, 2, 3], [2, 4, 6])).toBeCloseTo(0, 6);
    expect(spectralAngle([1, 0], [1, 1])).toBeCloseTo(Math.PI / 4);
    expect(spectralAngle([1, 0, 99], [1, 1, 0], (band) => band < 2)).toBeCloseTo(Math.PI / 4);
    expect(spectralAngle([1, NaN], [3, 5])).toBeCloseTo(0);
    expect(spectralAngle([0, 0], [1, 1])).toBeCloseTo(Math.PI / 2);
  });

  it("resamples between its ends", () => {
    expect([...resampled([400, 500], [1, 3], [400, 450, 500, 399, 501, null])]).toEqual([1, 2, 3, NaN, NaN, NaN]);
  });
});

describe("CSV", () => {
  it("writes curves with their deviations", () => {
    const text = writeCurves([400, null], [{ name: "point 1", mean: [0.5, NaN] }, { name: 'a "b"', mean: [1, 2], sd: [0.1, 0.2] }]);
    expect(text).toBe('band,wavelength_nm,point 1,"a ""b""","a ""b"" sd"\r\n0,400,0.5,1,0.1\r\n1,,,2,0.2\r\n');
    expect(quoted("=1+2")).toBe("'=1+2");
  });

  it("reads what instruments write", () => {
    const truth = { name: "r", nm: [400, 500.5], values: [0.1, 0.25] };
    expect(readReference("\uFEFFWavelength,Reflectance\r\n400,0.1\r\n500.5,0.25\r\n", "r")).toEqual(truth);
    expect(readReference("nm;R\n500,5;0,25\n400;0,1", "r")).toEqual(truth);
    expect(readReference("# x\n0.4 10\n0.5005\t25", "r")).toEqual(truth);
  });

  it.each([
    ["", "empty"], ["hello\nworld", "columns"], ["<!doctype html><p>1,2", "columns"], ["400,0.1\nfoo,bar", "columns"],
    ["400,0.1", "wavelengths"], ["400,0.1\n400,0.2", "wavelengths"], ["-1,2\n5,3", "wavelengths"], ["400\n500", "columns"],
  ])("says what is wrong with %j", (text, fault) => {
    expect(readReference(text, "r")).toBe(fault);
  });
});
