import { expect, it } from "vitest";
import { decode, encode, firstState, nearestBand, type ViewState } from "./view-state";

const first = firstState([460, 550, 640, 800, null]);

const all: ViewState = {
  camera: [1.5, -20.25, 80, 0, 0, 3],
  mode: "ratio",
  band: 3,
  bands: [3, 2, 1],
  pair: [0, 4],
  map: "magma",
  range: [-0.01234, 0.8],
  layer: "tissue-2",
  opacity: 0.25,
  section: { axis: "y", at: -3.5, flip: true },
  shape: "both",
  size: 2,
  chosen: [17, 4, 99],
};

it("restores what it wrote", () => {
  expect(decode(encode(all, first), first, 100, 5)).toEqual(all);
});

it("writes nothing of the first state", () => {
  expect(encode(first, first).toString()).toBe("");
  expect(decode(new URLSearchParams(), first, 100, 5)).toEqual(first);
});

it.each([
  "camera=1,2,3", "camera=a,b,c,d,e,f", "mode=xray", "band=5", "band=-1", "band=1.5", "rgb=1,2", "rgb=1,2,9", "pair=,",
  "map=jet", "range=2,1", "range=0,0", "layer=../x", "opacity=7", "section=q,1,lower", "section=x,1", "shape=cube", "size=0",
  "points=100", "points=-1,x", "map=constructor", "map=__proto__", "mode=__proto__", "camera=1e308,0,0,-1e308,0,0", "camera=0,0,1e7,0,0,0",
  "camera=1,2,3,1,2,3", "range=-1e308,1e308", `section=x,${"9".repeat(40)},lower`,
])("takes no harm from %s", (text) => {
  expect(decode(new URLSearchParams(text), first, 100, 5)).toEqual(first);
});

it("finds the nearest band, also without wavelengths", () => {
  expect(nearestBand([460, 550, 640], 590)).toBe(1);
  expect(nearestBand([null, null, null], 1000)).toBe(2);
});
