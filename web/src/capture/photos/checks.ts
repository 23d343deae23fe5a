/** What is read from the judgements of photos. */
import type { Schemas } from "../../api/client";

/** The corners of markers are for the service's own measuring. */
export type PhotoJudgement = Omit<Schemas["PhotoJudgement"], "markers">;
/** As the client types it, which makes arrays of the contract's pairs. */
export type CubeJudgement = Omit<Schemas["CubeJudgement"], "wavelength_nm"> & { wavelength_nm?: readonly number[] | null };
export type File = Omit<Schemas["File"], "judgement"> & { judgement: PhotoJudgement | CubeJudgement };
export interface Photo extends File {
  judgement: PhotoJudgement;
}

/** Photos that a good acquisition has. */
export const WANTED = 20;

/** The photos among files, in the order of their arrival. */
export function photosOf(files: readonly File[]): Photo[] {
  return files.filter((file): file is Photo => file.judgement.kind === "photo");
}

/** The markers around the specimen: those that two photos read, or any while there are few photos. */
export function markersOf(photos: readonly Photo[]): number[] {
  const counts = new Map<number, number>();
  for (const { judgement, state } of photos) {
    if (state === "accepted") for (const id of judgement.marker_ids) counts.set(id, (counts.get(id) ?? 0) + 1);
  }
  const least = photos.length > 3 ? 2 : 1;
  return [...counts].filter(([, n]) => n >= least).map(([id]) => id).sort((a, b) => a - b);
}

export interface Tally {
  /** Photos that a job uses. */
  usable: number;
  /** Of them, those that should be taken again, and refused ones. */
  again: number;
}

/** Count photos. */
export function tallied(photos: readonly Photo[]): Tally {
  return {
    usable: photos.filter(({ state }) => state === "accepted").length,
    again: photos.filter(({ judgement }) => judgement.verdict !== "accepted" && judgement.code !== "photo_duplicate").length,
  };
}

/** Whether a picked file may be a photo: browsers name the type of those they know, and leave HEIC and raw files open. */
export function maybePhoto({ name, type }: { name: string; type: string }): boolean {
  if (type.startsWith("image/")) return type !== "image/svg+xml";
  return type === "" && !/\.(txt|pdf|docx?|xlsx?|zip|mp4|mov|hdr|raw|json|csv)$/i.test(name);
}
