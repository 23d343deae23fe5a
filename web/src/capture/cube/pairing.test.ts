import { describe, expect, it } from "vitest";
import { announcedBytes, pairedUp, roleOf, stemOf, suffixOf } from "./pairing";

const files = (...names: string[]) => names.map((name) => ({ name, size: 10 }));
const shown = (names: string[], role?: "cube" | "white" | "dark") => {
  const found = pairedUp(files(...names), role);
  return {
    parts: found.parts.map(({ file, part, role: of }) => `${of}:${part}:${file.name}`),
    foreign: found.foreign.map(({ name }) => name),
    crowded: found.crowded,
    lacking: found.lacking,
  };
};

describe("names", () => {
  it.each([
    ["scan.hdr", "hdr"],
    ["scan", ""],
    ["a.b.RAW", "raw"],
    [".hidden", ""],
  ])("the end of %s", (name, end) => expect(suffixOf(name)).toBe(end));

  it.each(["scan.hdr", "scan.raw.hdr", "Scan.RAW", "scan", "scan.dat"])("%s is of the cube scan", (name) =>
    expect(stemOf(name)).toBe("scan"),
  );

  it.each([
    ["WHITEREF_scan.hdr", "white"],
    ["white.raw", "white"],
    ["scan_dark.raw", "dark"],
    ["DARKREF_scan.raw", "dark"],
    ["darkness.raw", "cube"],
    ["scan.raw", "cube"],
  ])("%s is a %s", (name, role) => expect(roleOf(name)).toBe(role));
});

describe("picked files", () => {
  it("finds header and data, the header first", () => {
    expect(shown(["scan.raw", "scan.hdr"])).toEqual({
      parts: ["cube:header:scan.hdr", "cube:data:scan.raw"],
      foreign: [],
      crowded: [],
      lacking: {},
    });
  });

  it("finds references beside the cube", () => {
    const { parts, crowded } = shown(["scan.raw", "scan.hdr", "WHITEREF_scan.hdr", "WHITEREF_scan.raw"]);
    expect(parts).toHaveLength(4);
    expect(crowded).toEqual([]);
  });

  it("says which part is missing", () => {
    expect(shown(["scan.raw"]).lacking).toEqual({ cube: "header" });
    expect(shown(["scan.hdr"]).lacking).toEqual({ cube: "data" });
    expect(shown(["scan.nc"]).lacking).toEqual({});
  });

  it("takes the data of another name where there is but one header", () => {
    expect(shown(["header.hdr", "cube.raw"]).lacking).toEqual({});
  });

  it("leaves out what no cube is", () => {
    expect(shown(["scan.hdr", "scan.raw", "scan.png", "notes.txt", "overview.img"]).foreign).toEqual([
      "scan.png",
      "notes.txt",
      "overview.img",
    ]);
  });

  it("says where there are two cubes for one role", () => {
    expect(shown(["a.hdr", "a.raw", "b.hdr", "b.raw"]).crowded).toEqual(["cube"]);
    expect(shown(["a.nc", "b.nc"]).crowded).toEqual(["cube"]);
    expect(shown(["a.hdr", "a.nc"]).crowded).toEqual(["cube"]);
  });

  it("believes the person about the role", () => expect(shown(["a.nc"], "dark").parts).toEqual(["dark:whole:a.nc"]));
});

describe("an ENVI header", () => {
  const header = "ENVI\nsamples = 512\nlines   = 640\nbands = 64\ndata type = 12\nheader offset = 0\n";
  it("announces its data's bytes", () => expect(announcedBytes(header)).toBe(512 * 640 * 64 * 2));
  it("counts the offset", () => expect(announcedBytes(header.replace("offset = 0", "offset = 100"))).toBe(512 * 640 * 64 * 2 + 100));
  it("may not say", () => expect(announcedBytes("ENVI\nsamples = 512\n")).toBeNull());
  it("knows no such type", () => expect(announcedBytes(header.replace("= 12", "= 99"))).toBeNull());
});
