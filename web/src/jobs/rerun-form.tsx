import { useState } from "preact/hooks";
import { api, body, type Schemas } from "../api/client";
import { go } from "../app/route";
import { asProblem, type Problem } from "../api/problem";
import { ProblemBox } from "../ui/boxes";
import { t } from "./texts";

type Settings = Schemas["JobSettings"];

/** Repeat a job, with its settings or with changed ones; stages that the change does not touch are not repeated. */
export function RerunForm({ job }: { job: Schemas["Job"] }) {
  const [problem, setProblem] = useState<Problem | null>(null);
  const submit = async (event: SubmitEvent): Promise<void> => {
    event.preventDefault();
    const data = new FormData(event.currentTarget as HTMLFormElement);
    const settings = { method: data.get("method") as Settings["method"], r_pc: Number(data.get("r_pc")) } as Settings;
    try {
      const made = await body(
        api.POST("/v1/jobs/{job_id}/rerun", { params: { path: { job_id: job.id } }, body: { settings } }),
      );
      go(["jobs", made.id]);
    } catch (thrown) {
      setProblem(asProblem(thrown));
    }
  };
  return (
    <details>
      <summary>{t("rerunWith")}</summary>
      <form class="row" onSubmit={(event) => void submit(event)}>
        <label>
          {t("grid")}{" "}
          <input name="r_pc" type="number" min="0.05" max="10" step="any" required value={job.settings.r_pc} />
        </label>
        <label>
          {t("method")}{" "}
          <select name="method" value={job.settings.method}>
            <option value="camera">camera</option>
            <option value="homography">homography</option>
          </select>
        </label>
        <button type="submit">{t("start")}</button>
      </form>
      {problem && <ProblemBox problem={problem} />}
    </details>
  );
}
