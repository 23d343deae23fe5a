/** Label layers of a cloud, as the service keeps them. */
import { api, body, fetched, PAGE_HEADER, type Schemas } from "../../api/client";
import { rgbOf } from "../colour/colour-maps";
import { readNpy, writeNpy } from "../data/npy";

export type Label = Schemas["Label"];
export type LabelClass = Label["classes"][number];

export interface LayerValues {
  label: Label;
  /** Class numbers (S,), or probabilities (S,) or (S, C). */
  values: Uint8Array | Uint16Array | Float32Array;
}

export function listLayers(cloudId: string): Promise<Label[]> {
  return body(api.GET("/v1/clouds/{cloud_id}/labels", { params: { path: { cloud_id: cloudId } } }));
}

/** Read a layer with the version that its values are of. */
export async function readLayer(cloudId: string, name: string): Promise<LayerValues> {
  const label = await body(api.GET("/v1/clouds/{cloud_id}/labels/{name}", { params: { path: { cloud_id: cloudId, name } } }));
  const answer = await fetched(`/v1/clouds/${cloudId}/labels/${name}/values?version=${label.version}`, {
    headers: { Accept: "application/x-npy" },
  });
  return { label, values: readNpy(await answer.arrayBuffer()).values as LayerValues["values"] };
}

/**
 * Write a layer's next version. `base` is the version it was made from; null: there must be none yet.
 * Throws a Problem: 412 where somebody else has changed the layer.
 */
export async function writeLayer(
  cloudId: string,
  name: string,
  classes: readonly LabelClass[],
  values: Uint8Array | Uint16Array,
  base: number | null,
  madeBy: string,
): Promise<Label> {
  const described = { kind: "class", classes, made_by: { name: madeBy, kind: "person" } };
  const answer = await fetched(`/v1/clouds/${cloudId}/labels/${name}`, {
    method: "PUT",
    headers: {
      ...PAGE_HEADER,
      "Content-Type": "application/x-npy",
      "X-Specimap-Label": latin1(JSON.stringify(described)),
      ...(base === null ? { "If-None-Match": "*" } : { "If-Match": `"${base}"` }),
    },
    body: writeNpy(values),
  });
  return (await answer.json()) as Label;
}

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
