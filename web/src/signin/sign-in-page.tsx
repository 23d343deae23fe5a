import { useEffect, useState } from "preact/hooks";
import { api, body, type Schemas } from "../api/client";
import { asProblem, type Problem } from "../api/problem";
import { query } from "../app/route";
import { sessionLost, signIn, signInElsewhere } from "../app/session";
import { texts } from "../i18n";
import { ProblemBox } from "../ui/boxes";

const en = {
  title: "Sign in",
  key: "Key",
  hint: "It begins with spk_. It is sent once and not kept in this browser.",
  enter: "Sign in",
  lost: "The session has ended. Sign in again; what was captured is still there.",
  account: "Sign in with your hospital account",
  accountOf: "Sign in with your account of {name}",
  withKey: "Sign in with a key",
  notIn: "You are not signed in.",
  away: "Your hospital's sign-in does not answer. Try again later, or sign in with a key.",
  noRole: "Your account has no role in Specimap. Ask whoever manages the accounts.",
  blocked: "Your account is blocked in Specimap. Ask whoever runs it.",
  late: "The sign-in took too long, or was used before. Begin again.",
  misplaced: "The sign-in was begun in another browser or window. Begin again here.",
  declined: "Your hospital's sign-in did not let you in.",
  misconfigured: "The answer of your hospital's sign-in does not count here. Tell whoever runs Specimap: {code}",
};
const it: typeof en = {
  title: "Accesso",
  key: "Chiave",
  hint: "Comincia con spk_. Viene inviata una volta e non resta in questo browser.",
  enter: "Accedi",
  lost: "La sessione è terminata. Accedi di nuovo; ciò che è stato acquisito è ancora qui.",
  account: "Accedi con il tuo account dell'ospedale",
  accountOf: "Accedi con il tuo account di {name}",
  withKey: "Accedi con una chiave",
  notIn: "L'accesso non è riuscito.",
  away: "Il sistema di accesso dell'ospedale non risponde. Riprova più tardi, o accedi con una chiave.",
  noRole: "Il tuo account non ha alcun ruolo in Specimap. Rivolgiti a chi gestisce gli account.",
  blocked: "Il tuo account è bloccato in Specimap. Rivolgiti a chi lo gestisce.",
  late: "L'accesso ha richiesto troppo tempo, o è già stato usato. Ricomincia.",
  misplaced: "L'accesso è iniziato in un altro browser o in un'altra finestra. Ricomincia qui.",
  declined: "Il sistema di accesso dell'ospedale non ti ha ammesso.",
  misconfigured: "La risposta del sistema di accesso dell'ospedale qui non vale. Avvisa chi gestisce Specimap: {code}",
};
const t = texts({ en, it });
/** Reasons with which the service sends a browser back, in words. */
const REASONS: Record<string, keyof typeof en> = {
  identity_unavailable: "away",
  no_role: "noRole",
  blocked: "blocked",
  attempt_unknown: "late",
  other_browser: "misplaced",
  provider_refused: "declined",
  other_issuer: "misconfigured",
  code_refused: "misconfigured",
  token_invalid: "misconfigured",
};

export function SignInPage() {
  const [problem, setProblem] = useState<Problem | null>(null);
  const [busy, setBusy] = useState(false);
  const [account, setAccount] = useState<Schemas["SsoOptions"] | null>(null);
  useEffect(() => {
    // Where that is not known, a key signs in all the same.
    body(api.GET("/v1/sso")).then(setAccount, () => undefined);
  }, []);
  const code = query.value.get("sso");
  const reason = code !== null && Object.hasOwn(REASONS, code) ? REASONS[code] : undefined;

  const submit = async (event: SubmitEvent): Promise<void> => {
    event.preventDefault();
    const form = event.currentTarget as HTMLFormElement;
    const field = form.elements.namedItem("key") as HTMLInputElement;
    setBusy(true);
    try {
      await signIn({ key: field.value.trim() });
    } catch (thrown) {
      setProblem(asProblem(thrown));
      field.select();
    } finally {
      setBusy(false);
    }
  };

  return (
    <form class="page narrow" onSubmit={(event) => void submit(event)}>
      <h1>{t("title")}</h1>
      {sessionLost.value && !reason && <p class="box warning">{t("lost")}</p>}
      {reason && (
        <p class="box problem" role="alert" data-testid="sign-in-refused">
          {t("notIn")} {t(reason, { code: code ?? "" })}
        </p>
      )}
      {account?.enabled && (
        <>
          <button type="button" class="primary big" onClick={signInElsewhere} data-testid="sign-in-account">
            {account.name ? t("accountOf", { name: account.name }) : t("account")}
          </button>
          <h2>{t("withKey")}</h2>
        </>
      )}
      <label for="key">{t("key")}</label>
      <input
        id="key"
        name="key"
        type="password"
        autocomplete="off"
        spellcheck={false}
        required
        aria-describedby="key-hint"
      />
      <p id="key-hint" class="small">
        {t("hint")}
      </p>
      <button type="submit" class={account?.enabled ? "" : "primary"} disabled={busy}>
        {t("enter")}
      </button>
      {problem && <ProblemBox problem={problem} />}
    </form>
  );
}
