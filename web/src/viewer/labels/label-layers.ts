/** Label layers of a cloud, as the service keeps them. */
import { api, body, fetched, PAGE_HEADER, type Schemas } from "../../api/client";
import { readNpy, writeNpy } from "../data/npy";
import { latin1, type LabelClass } from "./classes";

export type Label = Schemas["Label"];

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
