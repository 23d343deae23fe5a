import { useEffect, useState } from "preact/hooks";
import { api, BASE, body } from "../api/client";
import { asProblem, type Problem } from "../api/problem";
import { query } from "../app/route";
import { findSession } from "../app/session";
import { ProblemBox } from "../ui/boxes";
import { t } from "./texts";
import { Viewer } from "./viewer";
import { ViewerModel } from "./viewer-model";
import "./viewer.css";

/** `#/view/<cloud id>?<state of the view>` */
export default function ViewerPage({ parts }: { parts: readonly string[] }) {
  const cloudId = parts[0] ?? "";
  const [model, setModel] = useState<ViewerModel | null>(null);
  const [problem, setProblem] = useState<Problem | null>(null);
  const [round, setRound] = useState(0);
  useEffect(() => {
    let made: ViewerModel | null = null;
    let leftPage = false;
    const left = (): boolean => leftPage;
    setProblem(null);
    const open = async (): Promise<void> => {
      while (!left()) {
        try {
          const info = await body(api.GET("/v1/clouds/{cloud_id}", { params: { path: { cloud_id: cloudId } } }));
          if (left()) return;
          made = new ViewerModel(info, query.peek());
          setModel(made);
          return;
        } catch (thrown) {
          if (left()) return;
          const met = asProblem(thrown);
          setProblem(met);
          // A service that restarts is waited for; a refusal stays one.
          if (met.status !== 0 && met.status !== 429 && met.status < 502) return;
          await new Promise((resolve) => setTimeout(resolve, (met.retryAfter ?? 2) * 1000));
        }
      }
    };
    void open();
    return () => {
      leftPage = true;
      setModel(null);
      made?.close();
    };
  }, [cloudId, round]);
  const failed = model?.loader.problem.value;
  useEffect(() => {
    // The reader lives in a worker, beside the client that knows of lost sessions.
    if (failed?.status === 401) void findSession();
  }, [failed]);

  if (model === null) {
    return problem ? (
      <div class="page">
        {problem.status === 404 && <h1>{t("gone")}</h1>}
        <ProblemBox problem={problem} again={() => setRound((n) => n + 1)} />
      </div>
    ) : (
      <p class="loading" role="status">
        {t("opening")}
      </p>
    );
  }
  if (failed) {
    return (
      <div class="page">
        {failed.status === 404 && <h1>{t("gone")}</h1>}
        <ProblemBox problem={failed} again={() => setRound((n) => n + 1)} />
      </div>
    );
  }
  return <Viewer model={model} fallback={<Previews cloudId={cloudId} />} />;
}

/** What is shown where the browser cannot draw the cloud itself. */
function Previews({ cloudId }: { cloudId: string }) {
  return (
    <div class="page" data-testid="no-webgl">
      <p class="box warning" role="alert">
        {t("noWebGl")}
      </p>
      <div class="row">
        {(["rgb", "pca"] as const).map((name) => (
          <img
            class="preview"
            src={`${BASE}/v1/clouds/${cloudId}/previews/${name}.png?grid=marker`}
            alt={t(name === "rgb" ? "photo" : "pca")}
          />
        ))}
      </div>
    </div>
  );
}
