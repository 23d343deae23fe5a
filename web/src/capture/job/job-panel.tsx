/** The job: what it still needs, its start, its stages, and what to do when it fails. */
import { useEffect, useState } from "preact/hooks";
import { api, body } from "../../api/client";
import { asProblem, type Problem } from "../../api/problem";
import { href } from "../../app/route";
import { may } from "../../app/session";
import { doneShare, secondsLeft } from "../../jobs/time-left";
import { ProblemBox } from "../../ui/boxes";
import type { Acquisition } from "../acquisition-data";
import { said } from "../judgement-texts";
import { WANTED } from "../photos/checks";
import { t } from "../texts";
import { isFinal, useJobs } from "./follow";
import { remedyOf } from "./remedy";
import { rounded, stagesOf, type Job } from "./time-left";
import { randomId } from "../../ui/browser";

/** Photos without which the service runs no job. */
const LEAST = 6;

interface Props {
  acquisition: Acquisition;
  enough: boolean;
  onTheWay: number;
  /** Open the camera; delete the cube, so that another one can be sent. */
  retake: { photos: () => void; cube: () => Promise<void> };
}

export function JobPanel({ acquisition, enough, onTheWay, retake }: Props) {
  const jobs = useJobs(acquisition.id);
  const [urgent, setUrgent] = useState(true);
  const [problem, setProblem] = useState<Problem | null>(null);
  const [busy, setBusy] = useState(false);
  const [token, setToken] = useState(() => randomId());
  const job = jobs.data?.[0];

  const act = async (work: () => Promise<unknown>): Promise<void> => {
    setBusy(true);
    try {
      await work();
      setProblem(null);
      setToken(randomId());
      jobs.again();
    } catch (thrown) {
      const refused = asProblem(thrown);
      if (refused.status !== 0 && refused.status < 500) setToken(randomId());
      setProblem(refused);
    } finally {
      setBusy(false);
    }
  };
  const start = (): Promise<void> =>
    act(async () => {
      const priority = may("job.urgent") && urgent ? "intraoperative" : "routine";
      const params = { header: { "idempotency-key": token } };
      await body(api.POST("/v1/jobs", { body: { acquisition_id: acquisition.id, priority }, params }));
    });
  const stop = (job_id: string): Promise<void> =>
    act(async () => await api.POST("/v1/jobs/{job_id}/cancel", { params: { path: { job_id } } }));

  const running = job !== undefined && !isFinal(job);
  return (
    <section aria-labelledby="job-title" class="job">
      <h2 id="job-title">{t("job")}</h2>
      {job && <JobState job={job} retake={{ ...retake, cube: () => void act(retake.cube) }} />}
      {running && (
        <button type="button" class="danger" disabled={busy} onClick={() => void stop(job.id)} data-testid="cancel-job">
          {t("stop")}
        </button>
      )}
      {!running && jobs.data && (
        <Start acquisition={acquisition} enough={enough} onTheWay={onTheWay} busy={busy} before={job} start={() => void start()} urgent={urgent} setUrgent={setUrgent} />
      )}
      {problem && <ProblemBox problem={problem} />}
    </section>
  );
}

interface StartProps {
  acquisition: Acquisition;
  enough: boolean;
  onTheWay: number;
  busy: boolean;
  before: Job | undefined;
  start: () => void;
  urgent: boolean;
  setUrgent: (urgent: boolean) => void;
}

function Start({ acquisition: { ready, files }, enough, onTheWay, busy, before, start, urgent, setUrgent }: StartProps) {
  const what = [
    ...(files.photos < LEAST ? [t("missingPhotos", { n: files.photos })] : []),
    ...(files.cube ? [] : [t("missingCube")]),
  ];
  if (!ready && what.length === 0) what.push(t("missingReference"));
  const few = !enough && files.photos < WANTED;
  return (
    <>
      {!ready && (
        <p class="small" data-testid="missing">
          {t("missing", { what: what.join(", ") })}
        </p>
      )}
      {may("job.urgent") && (
        <label class="check">
          <input type="checkbox" checked={urgent} onChange={(event) => setUrgent(event.currentTarget.checked)} /> {t("urgent")}
        </label>
      )}
      <button type="button" class={`big${few || before?.state === "succeeded" ? "" : " primary"}`} disabled={!ready || busy || onTheWay > 0} onClick={start} data-testid="start-job">
        {before ? t("rerun") : ready && few ? t("startFew", { n: files.photos }) : t("start")}
      </button>
      {onTheWay > 0 && (
        <p class="small">
          {t("onTheWay", { n: onTheWay })}. {t("waitUploads")}
        </p>
      )}
    </>
  );
}

interface StateProps {
  job: Job;
  retake: { photos: () => void; cube: () => void };
}

const STAGE_TEXTS = { done: "stageDone", now: "stageNow", failed: "stageFailed", ahead: "stageAhead" } as const;

function JobState({ job, retake }: StateProps) {
  const share = job.state === "succeeded" ? 1 : doneShare(job.stage, job.progress);
  return (
    <div data-testid="job-state" data-state={job.state}>
      <p role="status">
        <strong class={job.state === "succeeded" ? "good" : job.state === "failed" ? "bad" : ""}>
          {job.state === "queued" ? (job.queue_position ? t("queued", { n: job.queue_position }) : t("queuedNext")) : t(job.state)}
        </strong>
        {job.state === "running" && <TimeLeft job={job} />}
      </p>
      {!isFinal(job) && <progress max={1} value={share} aria-label={t("job")} />}
      <ol class="stages">
        {stagesOf(job).map(([stage, at]) => (
          <li class={at} data-testid="job-stage" data-stage={stage} data-at={at} aria-current={at === "now" ? "step" : undefined}>
            {t(stage)} <span class="hidden">: {t(STAGE_TEXTS[at])}</span>
          </li>
        ))}
      </ol>
      {job.error && <Failure job={job} retake={retake} />}
      {job.cloud_id && (
        <a class="button primary big" href={href(["view", job.cloud_id])} data-testid="view-cloud">
          {t("view")}
        </a>
      )}
    </div>
  );
}

function Failure({ job: { error }, retake }: StateProps) {
  if (!error) return null;
  const remedy = remedyOf(error.code);
  const { reason, advice } = said(error.code, error.message, error.advice);
  return (
    <div class="box problem" role="alert" data-testid="job-failure">
      <p>{reason}</p>
      <p>{advice}</p>
      <p class="small">
        <code>{error.code}</code>
      </p>
      {remedy && (
        <button type="button" class="primary" onClick={retake[remedy]} data-testid={`retake-${remedy}`}>
          {t(remedy === "photos" ? "retakePhotos" : "retakeCube")}
        </button>
      )}
    </div>
  );
}

function TimeLeft({ job }: { job: Job }) {
  const [now, setNow] = useState(Date.now);
  useEffect(() => {
    const timer = setInterval(() => setNow(Date.now()), 1000);
    return () => clearInterval(timer);
  }, []);
  const left = secondsLeft(job, now);
  if (left === null) return null;
  const about = rounded(left);
  const time = about < 120 ? t("seconds", { n: about }) : t("minutes", { n: Math.round(about / 60) });
  return <span class="small">: {t("left", { time })}</span>;
}
