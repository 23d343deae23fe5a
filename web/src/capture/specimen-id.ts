/** A specimen's pseudonym, as the service takes it. */
export const PATTERN = "[A-Za-z0-9._\\-]{1,64}";
const WHOLE = new RegExp(`^${PATTERN}$`, "v");

/** Whether a text may be a specimen's id. */
export function isSpecimenId(text: string): boolean {
  return WHOLE.test(text);
}
