import { api, body, type Schemas } from "../api/client";
import { href } from "../app/route";
import { moment, number } from "../i18n";
import { stateClass, stateName } from "../i18n/states";
import { PagedTable } from "../ui/paged";
import { t } from "./texts";

type Job = Schemas["Job"];

/** The jobs of an acquisition, or all; the newest first. */
export function JobTable({ acquisition, state }: { acquisition?: string; state?: Job["state"] }) {
  return (
    <PagedTable<Job>
      name={`jobs ${acquisition ?? ""} ${state ?? ""}`}
      testid="jobs"
      seconds={3}
      ask={(after) =>
        body(
          api.GET("/v1/jobs", {
            params: {
              query: {
                limit: 50,
                ...(after ? { after } : {}),
                ...(acquisition ? { acquisition_id: acquisition } : {}),
                ...(state ? { state: [state] } : {}),
              },
            },
          }),
        )
      }
      head={[t("created"), t("state"), t("priority"), t("took"), t("result")]}
      empty={t("none")}
      row={(job) => (
        <>
          <td>
            <a href={href(["jobs", job.id])}>{moment(job.created_at)}</a>
          </td>
          <td>
            <span class={stateClass(job.state)}>{stateName(job.state)}</span>
            {job.state === "running" && job.stage && (
              <div class="small">
                {stateName(job.stage)} {number(job.progress * 100)} %
              </div>
            )}
            {job.error && <div class="small">{job.error.message}</div>}
          </td>
          <td>{stateName(job.priority)}</td>
          <td>{took(job)}</td>
          <td>
            {job.cloud_id && <a href={href(["view", job.cloud_id])}>{t("view")}</a>}
          </td>
        </>
      )}
    />
  );
}

/** Seconds from a job's start to its end. */
export function took(job: Job): string {
  if (job.started_at === null || job.finished_at === null) return "";
  return `${number((Date.parse(job.finished_at) - Date.parse(job.started_at)) / 1000, 1)} s`;
}
