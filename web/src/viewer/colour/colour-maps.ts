/** Perceptual colour maps as tables of 256 colours, from a few anchors each (Matplotlib's; balance after Moreland). */

const ANCHORS = {
  viridis: "440154 482878 3e4989 31688e 26828e 1f9e89 35b779 6ece58 b5de2b fde725",
  magma: "000004 180f3d 440f76 721f81 9e2f7f cd4071 f1605d fd9668 feca8d fcfdbf",
  cividis: "00224e 123570 3b496c 575d6d 707173 8a8678 a59c74 c3b369 e1cc55 fee838",
  grey: "000000 ffffff",
  balance: "3b4cc0 6788ee 9abbff c9d7f0 edd1c2 f7a889 e26952 b40426",
} as const;

export type ColourMapName = keyof typeof ANCHORS;
export const COLOUR_MAPS = Object.keys(ANCHORS) as ColourMapName[];

export function isColourMap(name: string | null): name is ColourMapName {
  return name !== null && Object.hasOwn(ANCHORS, name);
}

const made = new Map<ColourMapName, Uint8Array>();

/** 256 colours, three bytes each. */
export function colourTable(name: ColourMapName): Uint8Array {
  let table = made.get(name);
  if (!table) {
    const anchors = ANCHORS[name].split(" ").map(rgbOf);
    table = Uint8Array.from({ length: 768 }, (_, i) => {
      const at = (Math.floor(i / 3) / 255) * (anchors.length - 1);
      const left = Math.min(Math.floor(at), anchors.length - 2);
      const a = anchors[left]?.[i % 3] ?? 0, b = anchors[left + 1]?.[i % 3] ?? 0;
      return Math.round(a + (b - a) * (at - left));
    });
    made.set(name, table);
  }
  return table;
}

/** Red, green, blue (0 to 255) of `rrggbb`, with or without `#`. */
export function rgbOf(hex: string): [number, number, number] {
  const value = parseInt(hex.replace("#", ""), 16);
  return [(value >> 16) & 255, (value >> 8) & 255, value & 255];
}

/** Colours for what is told apart: curves, classes without a colour (Okabe and Ito, told apart by the colour-blind). */
export const DISTINCT = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#b8a800", "#7f7f7f"] as const;

export function distinct(i: number): string {
  return DISTINCT[i % DISTINCT.length] ?? DISTINCT[0];
}
