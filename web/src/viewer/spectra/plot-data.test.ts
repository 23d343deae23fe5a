// @vitest-environment happy-dom
import { expect, it } from "vitest";
import { badSpans, plotSvg } from "./plot-data";

it("greys bad bands half-way to their neighbours, and joins them", () => {
  expect(badSpans([400, 410, 420, 430], [0, 1, 2, 3], [1, 2])).toEqual([[405, 425]]);
  expect(badSpans([400, 410, 420], [2, 1, 0], [0, 2])).toEqual([[400, 405], [415, 420]]);
  expect(badSpans([400, 410], [0, 1], [])).toEqual([]);
});

it("draws curves as an SVG that parses, with gaps where there is no value", () => {
  const svg = plotSvg({
    x: [400, 500, 600, 700], order: [0, 1, 2, 3], bad: [3],
    curves: [{ name: 'a <b> & "c"', colour: "#d55e00", mean: [0, NaN, 1, 0.5], sd: [0.1, NaN, 0.1, 0.1] }],
    xLabel: "nm", yLabel: "R",
  });
  const parsed = new DOMParser().parseFromString(svg, "image/svg+xml");
  expect(parsed.querySelector("parsererror")).toBeNull();
  expect(svg).toContain("a &#60;b&#62; &#38; &#34;c&#34;");
  const curve = [...svg.matchAll(/<path d="([^"]*)" fill="none" stroke="#d55e00"/g)][0]?.[1] ?? "";
  expect(curve.match(/M/g)).toHaveLength(2);
  expect(curve).not.toContain("NaN");
});
