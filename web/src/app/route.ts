/** The page that the address names. All of it lies in the fragment, so that no server or proxy sees what is looked at. */
import { computed, signal } from "@preact/signals";

function fragment(): string {
  return location.hash.replace(/^#\/?/, "");
}

const current = signal(fragment());
addEventListener("hashchange", () => (current.value = fragment()));

/** Parts of the path: `#/view/cloud_1?band=3` has `["view", "cloud_1"]`. */
export const path = computed(() =>
  (current.value.split("?")[0] ?? "").split("/").filter(Boolean).map(safelyDecoded),
);

/** What follows `?` in the fragment. */
export const query = computed(() => new URLSearchParams(current.value.split("?").slice(1).join("?")));

/** Write an address within the pages, for links. */
export function href(parts: readonly string[], values: Record<string, string> = {}): string {
  const search = new URLSearchParams(values).toString();
  return `#/${parts.map(encodeURIComponent).join("/")}${search ? `?${search}` : ""}`;
}

/** Go to a page. */
export function go(parts: readonly string[], values: Record<string, string> = {}): void {
  location.hash = href(parts, values);
}

/** Show another page in place of this one: going back does not lead here again. */
export function setPath(parts: readonly string[]): void {
  history.replaceState(null, "", href(parts));
  current.value = fragment();
}

/** Change what follows `?` without a new entry in the history. */
export function setQuery(values: URLSearchParams): void {
  const text = values.toString();
  history.replaceState(history.state, "", `#/${path.value.map(encodeURIComponent).join("/")}${text ? `?${text}` : ""}`);
  current.value = fragment();
}

function safelyDecoded(text: string): string {
  try {
    return decodeURIComponent(text);
  } catch {
    return text;
  }
}
