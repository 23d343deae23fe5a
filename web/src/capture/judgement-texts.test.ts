// @vitest-environment happy-dom
import { readFileSync } from "node:fs";
import { describe, expect, it } from "vitest";
import { chooseLanguage } from "../i18n";
import { PHOTOS } from "./job/remedy";
import { en, said } from "./judgement-texts";

const documented = readFileSync("../docs/errors.md", "utf-8");

describe("codes", () => {
  it("are those of the service", () => {
    const unknown = [...Object.keys(en), ...PHOTOS].filter((code) => !documented.includes(`\`${code}\``));
    expect(unknown).toEqual([]);
  });

  it("of files as they arrive all have words", () => {
    const section = documented.split("## Files as they arrive")[1]?.split("\n## ")[0] ?? "";
    const codes = [...section.matchAll(/`([a-z_]+)`/g)].map((found) => found[1] ?? "").filter((code) => /^(photo|cube|judging|few|no|marker)_/.test(code));
    expect(codes.length).toBeGreaterThan(15);
    expect(codes.filter((code) => !(code in en))).toEqual([]);
  });

  it("say what is wrong and what to do, in both languages", () => {
    chooseLanguage("it");
    expect(said("photo_blurred", "It is shaken.", "Take it again.").reason).toBe("Non è nitida.");
    chooseLanguage("en");
    expect(said("photo_blurred", "It is shaken.", "Take it again.")).toEqual({
      reason: "It is shaken.",
      advice: "Hold still, and tap on the specimen to focus.",
    });
    expect(said("new_code", "Something.", "Do it.")).toEqual({ reason: "Something.", advice: "Do it." });
  });
});
