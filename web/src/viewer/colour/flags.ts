/** The bits of a point's flags, and the colours that tell them apart. */
import { rgbOf } from "./colour-maps";

/** In order of weight: a point with several bits is shown in the colour of the last. */
export const FLAGS = [
  { bit: 1, key: "flagSpecimen", colour: "#8a8f94" },
  { bit: 2, key: "flagCard", colour: "#56b4e9" },
  { bit: 64, key: "flagUndercut", colour: "#cc79a7" },
  { bit: 32, key: "flagOccluded", colour: "#009e73" },
  { bit: 4, key: "flagGrazing", colour: "#e69f00" },
  { bit: 16, key: "flagInterpolated", colour: "#f0e442" },
  { bit: 8, key: "flagSaturated", colour: "#d55e00" },
  { bit: 128, key: "flagNoData", colour: "#7b2cbf" },
] as const;

const NONE = "#3a4048";

/** Write the colour of each point's weightiest flag. */
export function flagColours(flags: Uint8Array, into: Uint8Array): void {
  const table = Array.from({ length: 256 }, (_, value) => rgbOf(FLAGS.findLast(({ bit }) => value & bit)?.colour ?? NONE));
  for (let i = 0, at = 0; i < flags.length; i++, at += 4) {
    const [r, g, b] = table[flags[i] as number] as [number, number, number];
    into[at] = r;
    into[at + 1] = g;
    into[at + 2] = b;
  }
}
