import { render } from "preact";
import { useEffect } from "preact/hooks";
import { registerSW } from "virtual:pwa-register";
import { effect, signal } from "@preact/signals";
import { CurrentPage } from "./app/pages";
import { path, setPath } from "./app/route";
import { findSession, session, sessionProblem } from "./app/session";
import { Shell } from "./app/shell";
import { language } from "./i18n";
import { t } from "./i18n/common";
import { SharedPage } from "./signin/shared-page";
import { SignInPage } from "./signin/sign-in-page";
import { Guarded, Loading, ProblemBox } from "./ui/boxes";
import "./ui/styles.css";

effect(() => {
  document.documentElement.lang = language.value;
});

const waiting = signal<(() => void) | null>(null);
const update = registerSW({
  onNeedRefresh() {
    waiting.value = () => void update(true);
  },
});

function App() {
  useEffect(() => void findSession(), []);
  return (
    <Shell>
      {waiting.value && (
        <div class="box" role="status">
          {t("newVersion")}{" "}
          <button type="button" onClick={waiting.value}>
            {t("reload")}
          </button>
        </div>
      )}
      <Guarded key={path.value.join("/")}>
        <Content />
      </Guarded>
    </Shell>
  );
}

function Content() {
  if (path.value[0] === "shared") return <SharedPage token={path.value[1] ?? ""} />;
  if (session.value === undefined) {
    return sessionProblem.value ? (
      <ProblemBox problem={sessionProblem.value} again={() => void findSession()} />
    ) : (
      <Loading />
    );
  }
  if (session.value === null) return <SignInPage />;
  const { cloud_id } = session.value;
  return cloud_id !== null && path.value[0] !== "view" ? <ToShared cloud={cloud_id} /> : <CurrentPage />;
}

/** Whoever came by a shared link sees its result wherever the address leads: there is nothing else to see. */
function ToShared({ cloud }: { cloud: string }) {
  useEffect(() => setPath(["view", cloud]), [cloud]);
  return <Loading />;
}

const root = document.getElementById("app");
if (root) render(<App />, root);
