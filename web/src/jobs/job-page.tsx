import { api, body, type Schemas } from "../api/client";
import { usePolled } from "../api/polling";
import { go, href } from "../app/route";
import { may } from "../app/session";
import { moment } from "../i18n";
import { stateClass, stateName } from "../i18n/states";
import { Action } from "../ui/action";
import { Loading, ProblemBox, Progress } from "../ui/boxes";
import { Downloads } from "./downloads";
import { took } from "./job-table";
import { ReportSection } from "./report-section";
import { RerunForm } from "./rerun-form";
import { t } from "./texts";
import { doneShare, secondsLeft, STAGES } from "./time-left";

type Job = Schemas["Job"];

const ENDED = ["succeeded", "failed", "cancelled"];

/** One job: how far it is, or how it ended, and what can be done with it. */
export function JobPage({ id }: { id: string }) {
  const at = { params: { path: { job_id: id } } };
  const found = usePolled(id, () => body(api.GET("/v1/jobs/{job_id}", at)), 1.5);
  const job = found.data;
  if (job === undefined) {
    return <div class="page">{found.problem ? <ProblemBox problem={found.problem} again={found.again} /> : <Loading />}</div>;
  }
  const ended = ENDED.includes(job.state);
  return (
    <div class="page" data-testid="job" data-state={job.state}>
      <h1>
        {t("job")}: <span class={stateClass(job.state)}>{stateName(job.state)}</span>
      </h1>
      {found.problem && <ProblemBox problem={found.problem} again={found.again} />}
      <p class="small">
        {t("created")} {moment(job.created_at)} · {stateName(job.priority)} ·{" "}
        <a href={href(["acquisitions", job.acquisition_id])}>{t("acquisition")}</a>
        {took(job) && <> · {took(job)}</>}
      </p>
      <Running job={job} />
      {job.error && (
        <div class="box problem">
          <h2>{t("why")}</h2>
          <p>{job.error.message}</p>
          <p>{job.error.advice}</p>
          <p class="small">
            <code>{job.error.code}</code>
          </p>
        </div>
      )}
      {job.cloud_id && (
        <p>
          <a class="button primary" href={href(["view", job.cloud_id])} data-testid="open-viewer">
            {t("view")}
          </a>
        </p>
      )}
      {job.state === "succeeded" && <ReportSection job={id} />}
      {job.cloud_id && <Downloads cloud={job.cloud_id} />}
      {may("job.run") && (
        <div class="row">
          {!ended && (
            <Action
              text={t("cancel")}
              confirm={t("sureCancel")}
              done={found.again}
              run={() => api.POST("/v1/jobs/{job_id}/cancel", at)}
            />
          )}
          {ended && <RerunForm job={job} />}
          {ended && (
            <Action
              text={t("remove")}
              kind="danger"
              confirm={t("sureRemove")}
              done={() => go(["acquisitions", job.acquisition_id])}
              run={() => api.DELETE("/v1/jobs/{job_id}", at)}
            />
          )}
        </div>
      )}
      <Log id={id} ended={ended} />
    </div>
  );
}

function Running({ job }: { job: Job }) {
  if (job.state === "queued" && job.queue_position !== null) {
    return <p>{job.queue_position === 0 ? t("next") : t("ahead", { n: job.queue_position })}</p>;
  }
  if (job.state !== "running" || job.stage === null) return null;
  const left = secondsLeft(job, Date.now());
  const text = t("stage", { k: STAGES.indexOf(job.stage) + 1, name: stateName(job.stage) });
  return (
    <div role="status" data-testid="job-stage">
      <p>
        {text} {left !== null && <span class="small">{t("left", { n: left })}</span>}
      </p>
      <Progress value={doneShare(job.stage, job.progress)} label={text} />
    </div>
  );
}

function Log({ id, ended }: { id: string; ended: boolean }) {
  const log = usePolled(
    `log ${id} ${ended}`,
    () => body(api.GET("/v1/jobs/{job_id}/log", { params: { path: { job_id: id }, query: { limit: 500 } } })),
    ended ? 0 : 3,
  );
  if (!log.data || log.data.items.length === 0) return null;
  return (
    <details>
      <summary>{t("log")}</summary>
      <ol class="log">
        {log.data.items.map((line) => (
          <li key={line.seq} class={line.level === "error" ? "bad" : line.level === "warning" ? "fair" : ""}>
            <span class="small">{new Date(line.at).toLocaleTimeString()}</span> {line.message}
          </li>
        ))}
      </ol>
    </details>
  );
}
