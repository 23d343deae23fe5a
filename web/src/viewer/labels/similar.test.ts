import { expect, it } from "vitest";
import { likeRows } from "./similar";

it("finds rows of like shape, without bad bands, and leaves out what has no value", () => {
  const decode = { scale: 0.001, offset: 0, fill: 65535 };
  const rows = Uint16Array.of(100, 200, 9999, 200, 400, 0, 300, 100, 0, 65535, 65535, 65535);
  const wanted = { spectrum: [0.1, 0.2, 0], most: 0.05, usedBands: [true, true, false] };
  expect(likeRows(rows, 3, decode, wanted)).toEqual([0, 1]);
  expect(likeRows(rows, 3, decode, { ...wanted, most: 1 })).toEqual([0, 1, 2]);
});
