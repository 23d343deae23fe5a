import { expect, it } from "vitest";
import { COLOUR_MAPS, colourTable } from "./colour-maps";
import { NO_VALUE_RGB, normalisedDifference, paintChannel, paintClasses, paintScalar, percentiles, ratio, ticks } from "./scale";

it("finds percentiles of finite values", () => {
  const values = Float32Array.from({ length: 101 }, (_, i) => i);
  expect(percentiles(values, 2, 98)).toEqual([2, 98]);
  expect(percentiles([NaN, 5, Infinity, 7], 0, 100)).toEqual([5, 7]);
  expect(percentiles([NaN], 2, 98)).toEqual([0, 1]);
  const [low, high] = percentiles([3, 3], 2, 98);
  expect(high).toBeGreaterThan(low);
});

it("paints the ends of a range in the ends of the table, and no value in grey", () => {
  const into = new Uint8Array(20);
  paintScalar(Float32Array.of(-1, 0, 1, 2, NaN), [0, 1], colourTable("grey"), into);
  expect([...into]).toEqual([0, 0, 0, 0, 0, 0, 0, 0, 255, 255, 255, 0, 255, 255, 255, 0, ...NO_VALUE_RGB, 0]);
});

it("paints a channel alone", () => {
  const into = new Uint8Array(12).fill(7);
  paintChannel(Float32Array.of(0, 0.5, NaN), [0, 1], 1, into);
  expect([...into]).toEqual([7, 0, 7, 7, 7, 127, 7, 7, 7, 0, 7, 7]);
});

it("divides and compares bands", () => {
  expect([...ratio(Float32Array.of(1, 2), Float32Array.of(4, 0))]).toEqual([0.25, NaN]);
  expect([...normalisedDifference(Float32Array.of(3, 0), Float32Array.of(1, 0))]).toEqual([0.5, NaN]);
});

it("lays classes over colours with an opacity", () => {
  const into = Uint8Array.of(100, 100, 100, 255, 100, 100, 100, 255);
  paintClasses([0, 1], Uint8Array.of(0, 0, 0, 0, 200, 0, 100, 255), 0.5, into);
  expect([...into]).toEqual([100, 100, 100, 255, 150, 50, 100, 255]);
});

it("chooses round ticks", () => {
  expect(ticks([0.03, 0.61])).toEqual([0.2, 0.4, 0.6]);
  expect(ticks([-0.5, 0.5], 4)).toEqual([-0.5, 0, 0.5]);
});

it.each(COLOUR_MAPS.filter((name) => name !== "balance"))("%s grows lighter all along", (name) => {
  const table = colourTable(name);
  const light = Array.from({ length: 256 }, (_, i) =>
    0.2126 * (table[i * 3] ?? 0) + 0.7152 * (table[i * 3 + 1] ?? 0) + 0.0722 * (table[i * 3 + 2] ?? 0));
  for (let i = 1; i < 256; i++) expect(light[i]).toBeGreaterThanOrEqual((light[i - 1] ?? 0) - 0.5);
});
