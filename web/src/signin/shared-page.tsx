import { useEffect, useState } from "preact/hooks";
import { asProblem, type Problem } from "../api/problem";
import { go, query } from "../app/route";
import { session, sessionProblem, signIn } from "../app/session";
import { texts } from "../i18n";
import { Loading, ProblemBox } from "../ui/boxes";

const en = {
  title: "A shared result",
  instead: "You are signed in as “{name}”. The link opens a session of its own: it ends yours in this browser.",
  open: "Sign out and open the link",
  stay: "Stay signed in",
};
const it: typeof en = {
  title: "Un risultato condiviso",
  instead: "Sei connesso come “{name}”. Il collegamento apre una sessione propria: la tua termina in questo browser.",
  open: "Esci e apri il collegamento",
  stay: "Resta connesso",
};
const t = texts({ en, it });

/** Open a shared link: `#/shared/<token>?<state of the view>`. It takes nobody's own session away unasked. */
export function SharedPage({ token }: { token: string }) {
  const [agreed, setAgreed] = useState(false);
  const [problem, setProblem] = useState<Problem | null>(null);
  const mine = session.value;
  const known = mine !== undefined || sessionProblem.value !== null;
  const asks = !agreed && mine != null && mine.cloud_id === null;
  const opens = known && !asks;
  useEffect(() => {
    if (!opens) return;
    const view = Object.fromEntries(query.value);
    signIn({ share: token }).then(
      (made) => {
        history.replaceState(null, "", "#/");
        go(["view", made.cloud_id ?? ""], view);
      },
      (thrown: unknown) => {
        const refused = asProblem(thrown);
        // What is refused for good leaves the address; after a loss of the connection a reload tries again.
        if (refused.status >= 400 && refused.status < 500) history.replaceState(null, "", "#/");
        setProblem(refused);
      },
    );
  }, [token, opens]);
  if (problem) return <ProblemBox problem={problem} />;
  if (!asks) return <Loading />;
  return (
    <div class="page narrow">
      <h1>{t("title")}</h1>
      <p>{t("instead", { name: mine.name })}</p>
      <div class="row">
        <button type="button" class="primary" onClick={() => setAgreed(true)} data-testid="open-shared">
          {t("open")}
        </button>
        <button type="button" onClick={() => go([])}>
          {t("stay")}
        </button>
      </div>
    </div>
  );
}
