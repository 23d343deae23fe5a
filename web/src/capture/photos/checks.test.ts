import { describe, expect, it } from "vitest";
import { markersOf, maybePhoto, tallied, type Photo } from "./checks";

const photo = (verdict: "accepted" | "doubtful" | "refused", marker_ids: number[], code: string | null = null): Photo =>
  ({ state: verdict === "refused" ? "refused" : "accepted", judgement: { kind: "photo", verdict, code, marker_ids } }) as unknown as Photo;

describe("photos", () => {
  it("know the markers that are there, without a stray one", () => {
    expect(markersOf([photo("accepted", [0, 1])])).toEqual([0, 1]);
    const four = [photo("accepted", [0, 1, 2, 3]), photo("accepted", [3, 2, 17]), photo("doubtful", [1, 0]), photo("accepted", [0])];
    expect(markersOf(four)).toEqual([0, 1, 2, 3]);
    expect(markersOf([...four, photo("refused", [9]), photo("refused", [9])])).toEqual([0, 1, 2, 3]);
  });

  it("are counted", () => {
    const all = [photo("accepted", []), photo("doubtful", []), photo("refused", []), photo("refused", [], "photo_duplicate")];
    expect(tallied(all)).toEqual({ usable: 2, again: 2 });
  });

  it.each([
    ["a.jpg", "image/jpeg", true],
    ["a.heic", "", true],
    ["a.dng", "", true],
    ["a.pdf", "application/pdf", false],
    ["a.mov", "video/quicktime", false],
    ["a.svg", "image/svg+xml", false],
    ["scan.hdr", "", false],
  ])("%s (%s)", (name, type, may) => expect(maybePhoto({ name, type })).toBe(may));
});
