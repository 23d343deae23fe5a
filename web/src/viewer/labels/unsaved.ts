/** Layers with what was painted in them and is not saved, kept while this window lives: who leaves comes back to them. */
import { session } from "../../app/session";
import type { EditHistory } from "./edit-history";
import type { ShownLayer } from "./layer-model";

export interface Unsaved {
  layer: ShownLayer;
  history: EditHistory;
}

/** Each person finds their own: names of keys, clouds and layers have no blanks. */
const kept = new Map<string, Unsaved>();
const ofCloud = (cloud: string, who = whoPaints()): string => `${who} ${cloud} `;

/** The key of whoever is signed in; kept by those who paint, since a session may end before they leave. */
export function whoPaints(): string {
  return session.peek()?.key_id ?? "";
}

export function keep(cloud: string, who: string, unsaved: Unsaved): void {
  kept.set(ofCloud(cloud, who) + unsaved.layer.name, unsaved);
}

export function forget(cloud: string, who: string, name: string): void {
  kept.delete(ofCloud(cloud, who) + name);
}

export function unsavedLayer(cloud: string, name: string): Unsaved | undefined {
  return kept.get(ofCloud(cloud) + name);
}

export function unsavedNames(cloud: string): string[] {
  const mine = ofCloud(cloud);
  return [...kept.keys()].filter((key) => key.startsWith(mine)).map((key) => key.slice(mine.length));
}

// Closing the window loses them: the browser asks.
addEventListener("beforeunload", (event) => {
  if (kept.size > 0) event.preventDefault();
});
