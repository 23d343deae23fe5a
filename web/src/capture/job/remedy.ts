/** What is to be taken again when a job has failed. */

export const PHOTOS: ReadonlySet<string> = new Set([
  "depth_not_found",
  "marker_dictionary_wrong",
  "marker_geometry_unsolvable",
  "marker_ids_duplicate",
  "no_markers_found",
  "photos_not_connected",
  "result_insufficient",
  "too_few_photos",
]);

/** `photos`, `cube`, or nothing that this page could take again. */
export function remedyOf(code: string): "photos" | "cube" | null {
  if (PHOTOS.has(code)) return "photos";
  return code.startsWith("cube_") || code.endsWith("_in_cube") || code === "registration_failed" ? "cube" : null;
}
