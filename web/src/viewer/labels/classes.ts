/** Classes of label layers: colours, and how they are written. No DOM. */
import type { Schemas } from "../../api/client";
import { rgbOf } from "../colour/colour-maps";

export type LabelClass = Schemas["LabelClass"];

/** JSON for a header: letters beyond ASCII as escapes, which JSON reads back. */
export function latin1(json: string): string {
  return json.replace(/[^\x20-\x7e]/g, (letter) => `\\u${letter.charCodeAt(0).toString(16).padStart(4, "0")}`);
}

/** Colours by class number, four bytes each; alpha 0 where the class is not drawn. */
export function classColours(classes: readonly LabelClass[]): Uint8Array {
  const table = new Uint8Array((Math.max(0, ...classes.map((c) => c.value)) + 1) * 4);
  for (const { value, colour } of classes) if (colour) table.set([...rgbOf(colour), 255], value * 4);
  return table;
}

/** The class of each point where a layer holds probabilities: the largest from a half on; `none` elsewhere. */
export function mostProbable(values: Float32Array, points: number, classes: readonly LabelClass[], none: number): Uint16Array<ArrayBuffer> {
  const width = Math.max(1, Math.round(values.length / points));
  const out = new Uint16Array(points).fill(none);
  for (let i = 0; i < points; i++) {
    let most = 0.5;
    for (let c = 0; c < width; c++) {
      const value = values[i * width + c] as number;
      if (value >= most) {
        most = value;
        out[i] = classes[c]?.value ?? none;
      }
    }
  }
  return out;
}
