import { go, query } from "../app/route";
import { stateName } from "../i18n/states";
import { JobPage } from "./job-page";
import { JobTable } from "./job-table";
import { t } from "./texts";

const STATES = ["queued", "running", "succeeded", "failed", "cancelled"] as const;

/** All jobs, or the one that the address names. */
export default function JobsPage({ parts }: { parts: readonly string[] }) {
  const id = parts[0];
  if (id !== undefined) return <JobPage key={id} id={id} />;
  const state = STATES.find((name) => name === query.value.get("state"));
  return (
    <div class="page">
      <h1>{t("title")}</h1>
      <select
        aria-label={t("filter")}
        value={state ?? ""}
        onChange={(event) => go(["jobs"], event.currentTarget.value ? { state: event.currentTarget.value } : {})}
      >
        <option value="">{t("all")}</option>
        {STATES.map((name) => (
          <option value={name}>{stateName(name)}</option>
        ))}
      </select>
      <JobTable {...(state ? { state } : {})} />
    </div>
  );
}
