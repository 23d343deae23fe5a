/** What surrounds every page: the bar with links, language and sign-out; the line that says what this is. */
import type { ComponentChildren } from "preact";
import { chooseLanguage, language, LANGUAGES, type Language } from "../i18n";
import { t } from "../i18n/common";
import { href, path } from "./route";
import { isPerson, may, session, signOut } from "./session";

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
            {may("result.read") && LINKS.map(({ parts, text, first }) => (
              <a href={href(parts)} aria-current={(first as readonly string[]).includes(here) ? "page" : undefined}>
                {t(text)}
              </a>
            ))}
            {(may("key.manage") || may("audit.read")) && (
              <a href={href(["admin"])} aria-current={here === "admin" ? "page" : undefined}>
                {may("key.manage") ? t("administration") : t("audit")}
              </a>
            )}
          </nav>
        )}
        <span class="fill" />
        <LanguageChoice />
        {isPerson() && (
          <span class="small" data-testid="roles">
            {session.value?.roles.map(roleName).join(", ")}
          </span>
        )}
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

function roleName(role: string): string {
  return role in ROLES ? t(ROLES[role as keyof typeof ROLES]) : role;
}

const ROLES = {
  technician: "technician",
  clinician: "clinician",
  classifier: "classifier",
  admin: "administrator",
  auditor: "auditor",
} as const;

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
