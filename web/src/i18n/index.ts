/** Texts of the pages, English and Italian. Every part of the pages brings a table of its own. */
import { signal } from "@preact/signals";

export const LANGUAGES = { en: "English", it: "Italiano" } as const;
export type Language = keyof typeof LANGUAGES;

const KEPT = "specimap.language";

function first(): Language {
  const known = (name: string): name is Language => Object.hasOwn(LANGUAGES, name);
  const wanted = [stored(), ...navigator.languages.map((name) => name.slice(0, 2))];
  return wanted.find((name): name is Language => name !== null && known(name)) ?? "en";
}

function stored(): string | null {
  try {
    return localStorage.getItem(KEPT);
  } catch {
    return null;
  }
}

export const language = signal<Language>(first());

/** Choose the language, for this browser. */
export function chooseLanguage(name: Language): void {
  language.value = name;
  try {
    localStorage.setItem(KEPT, name);
  } catch {
    // A browser that keeps nothing asks again next time.
  }
}

type Values = Record<string, string | number>;

/**
 * Make the function that gives a part's texts in the language of the moment.
 *
 * `{name}` in a text stands for a value. A text may have a form for one: `one|many` chooses by the value `n`.
 */
export function texts<T extends Record<string, string>>(tables: {
  en: T;
  it: { [K in keyof T]: string };
}): (key: keyof T, values?: Values) => string {
  return (key, values = {}) => {
    const forms = tables[language.value][key].split("|");
    const form = (forms.length > 1 && values.n !== 1 ? forms[1] : forms[0]) ?? "";
    return form.replace(/\{(\w+)\}/g, (whole, name: string) => String(values[name] ?? whole));
  };
}

/** Write a number for readers. */
export function number(value: number, digits = 0): string {
  return value.toLocaleString(language.value, { maximumFractionDigits: digits, minimumFractionDigits: digits });
}

/** Write a moment (ISO 8601) in the reader's zone. */
export function moment(iso: string): string {
  return new Date(iso).toLocaleString(language.value, { dateStyle: "medium", timeStyle: "short" });
}

/** Write a size in bytes. */
export function bytes(size: number): string {
  const units = ["B", "kB", "MB", "GB", "TB"];
  let rank = 0;
  while (size >= 1000 && rank < units.length - 1) {
    size /= 1000;
    rank += 1;
  }
  return `${number(size, rank === 0 || size >= 100 ? 0 : 1)} ${units[rank] ?? ""}`;
}
