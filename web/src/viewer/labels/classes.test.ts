import { expect, it } from "vitest";
import { classColours, latin1, mostProbable } from "./classes";

it("writes any name as a header that JSON reads back", () => {
  const text = JSON.stringify({ name: "però – 肿瘤 😀" });
  expect(latin1(text)).toMatch(/^[\x20-\x7e]*$/);
  expect(JSON.parse(latin1(text))).toEqual({ name: "però – 肿瘤 😀" });
});

it("colours classes by number, and leaves out those without a colour", () => {
  const table = classColours([{ value: 0, name: "none", colour: null }, { value: 2, name: "tumour", colour: "#ff8000" }]);
  expect([...table]).toEqual([0, 0, 0, 0, 0, 0, 0, 0, 255, 128, 0, 255]);
});

it("takes the most probable class", () => {
  const classes = [{ value: 4, name: "a" }, { value: 9, name: "b" }];
  const values = Float32Array.of(0.9, 0.1, 0.3, 0.7, 0.4, 0.4, NaN, NaN);
  expect([...mostProbable(values, 4, classes, 0)]).toEqual([4, 9, 0, 0]);
  expect([...mostProbable(Float32Array.of(0.2, 0.5), 2, classes.slice(0, 1), 0)]).toEqual([0, 4]);
});
