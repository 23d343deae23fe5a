import { useState } from "preact/hooks";
import { asProblem, type Problem } from "../api/problem";
import { sessionLost, signIn } from "../app/session";
import { texts } from "../i18n";
import { ProblemBox } from "../ui/boxes";

const en = {
  title: "Sign in",
  key: "Key",
  hint: "It begins with spk_. It is sent once and not kept in this browser.",
  enter: "Sign in",
  lost: "The session has ended. Sign in again; what was captured is still there.",
};
const it: typeof en = {
  title: "Accesso",
  key: "Chiave",
  hint: "Comincia con spk_. Viene inviata una volta e non resta in questo browser.",
  enter: "Accedi",
  lost: "La sessione è terminata. Accedi di nuovo; ciò che è stato acquisito è ancora qui.",
};
const t = texts({ en, it });

export function SignInPage() {
  const [problem, setProblem] = useState<Problem | null>(null);
  const [busy, setBusy] = useState(false);

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
      {sessionLost.value && <p class="box warning">{t("lost")}</p>}
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
      <button type="submit" class="primary" disabled={busy}>
        {t("enter")}
      </button>
      {problem && <ProblemBox problem={problem} />}
    </form>
  );
}
