/** What surrounds every page: the bar with links, language and sign-out; the line that says what this is. */
import type { ComponentChildren } from "preact";
import { chooseLanguage, language, LANGUAGES, type Language } from "../i18n";
import { t } from "../i18n/common";
import { href, path } from "./route";
import { may, session, signOut } from "./session";

const LINKS = [
  { parts: [], text: "acquisitions", first: ["", "acquisitions", "capture"] },
  { parts: ["jobs"], text: "jobs", first: ["jobs"] },
  { parts: ["results"], text: "results", first: ["results"] },
] as const;

export function Shell({ children }: { children: ComponentChildren }) {
  const shared = session.value?.cloud_id != null;
  const here = path.value[0] ?? "";
  return (
    <div class="shell">
      <header class="bar">
        <a class="brand" href="#/">
          <img src="./icons/icon.svg" alt="" width="28" height="28" />
          Specimap
        </a>
        {session.value && !shared && (
          <nav aria-label="Specimap">
            {LINKS.map(({ parts, text, first }) => (
              <a href={href(parts)} aria-current={(first as readonly string[]).includes(here) ? "page" : undefined}>
                {t(text)}
              </a>
            ))}
            {may("admin") && (
              <a href={href(["admin"])} aria-current={here === "admin" ? "page" : undefined}>
                {t("administration")}
              </a>
            )}
          </nav>
        )}
        <span class="fill" />
        <LanguageChoice />
        {session.value && (
          <button type="button" class="quiet" onClick={() => void signOut()} title={session.value.name}>
            {t("signOut")}
          </button>
        )}
      </header>
      <main>{children}</main>
      <footer>{t("research")}</footer>
    </div>
  );
}

function LanguageChoice() {
  return (
    <select
      class="quiet"
      aria-label={t("language")}
      value={language.value}
      onChange={(event) => chooseLanguage(event.currentTarget.value as Language)}
    >
      {Object.entries(LANGUAGES).map(([name, text]) => (
        <option value={name} lang={name}>
          {text}
        </option>
      ))}
    </select>
  );
}
