/** Names of states, stages and priorities. */
import { texts } from ".";

const en = {
  queued: "waiting",
  running: "running",
  succeeded: "finished",
  failed: "failed",
  cancelled: "cancelled",
  reconstruct: "Cameras and depth",
  adjust: "Scale",
  render: "Surface",
  register: "Spectra onto surface",
  intraoperative: "during the operation",
  routine: "routine",
  research: "research",
  accepted: "good",
  doubtful: "doubtful",
  refused: "refused",
  photo: "photo",
  cube: "cube",
  white: "white reference",
  dark: "dark reference",
};
const it: typeof en = {
  queued: "in attesa",
  running: "in corso",
  succeeded: "terminata",
  failed: "fallita",
  cancelled: "annullata",
  reconstruct: "Camere e profondità",
  adjust: "Scala",
  render: "Superficie",
  register: "Spettri sulla superficie",
  intraoperative: "durante l’intervento",
  routine: "ordinaria",
  research: "ricerca",
  accepted: "buona",
  doubtful: "dubbia",
  refused: "rifiutata",
  photo: "foto",
  cube: "cubo",
  white: "riferimento bianco",
  dark: "riferimento scuro",
};
export type StateKey = keyof typeof en;
export const stateName = texts({ en, it });

const COLOURS: Partial<Record<StateKey, string>> = {
  succeeded: "good",
  accepted: "good",
  doubtful: "fair",
  failed: "bad",
  refused: "bad",
};

/** The class of a state's colour. */
export function stateClass(state: StateKey): string {
  return COLOURS[state] ?? "";
}
