import { describe, expect, it } from "vitest";
import { chunkRuns, levelOrder, shardsFromMiddle } from "./shard-plan";

describe("levelOrder", () => {
  it.each([1, 63, 64, 1000, 4099])("names each of %i points once", (points) => {
    expect([...levelOrder(points)].sort((a, b) => a - b)).toEqual(Array.from({ length: points }, (_, i) => i));
  });

  it("covers the cloud evenly with its first part", () => {
    const first = levelOrder(64 * 100).slice(0, 400);
    const perBlock = new Array<number>(100).fill(0);
    first.forEach((i) => (perBlock[i >> 6] = (perBlock[i >> 6] ?? 0) + 1));
    expect(new Set(perBlock)).toEqual(new Set([4]));
  });
});

it("reads the middle shards first, and all of them", () => {
  expect(shardsFromMiddle(10, 3).map((s) => s.start)).toEqual([3, 6, 0, 9]);
  expect(shardsFromMiddle(10, 3).at(-1)).toEqual({ start: 9, stop: 10 });
});

it("joins chunks that lie close together", () => {
  expect(chunkRuns([1, 2, 4, 9], 1)).toEqual([{ start: 1, stop: 5 }, { start: 9, stop: 10 }]);
  expect(chunkRuns([0, 1, 2, 3], 0, 2)).toEqual([{ start: 0, stop: 2 }, { start: 2, stop: 4 }]);
});
