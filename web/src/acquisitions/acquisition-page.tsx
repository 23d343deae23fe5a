import { api, body, BASE, type Schemas } from "../api/client";
import { usePolled } from "../api/polling";
import { go, href } from "../app/route";
import { may } from "../app/session";
import { bytes, moment } from "../i18n";
import { t as common } from "../i18n/common";
import { stateClass, stateName } from "../i18n/states";
import { JobTable } from "../jobs/job-table";
import { Action } from "../ui/action";
import { Loading, ProblemBox } from "../ui/boxes";
import { PagedTable } from "../ui/paged";
import { t } from "./texts";

/** One acquisition: its files with their verdicts, its jobs, and what can be done with it. */
export default function AcquisitionPage({ parts }: { parts: readonly string[] }) {
  const id = parts[0] ?? "";
  const found = usePolled(id, () => body(api.GET("/v1/acquisitions/{acquisition_id}", { params: { path: { acquisition_id: id } } })), 5);
  if (found.data === undefined) {
    return <div class="page">{found.problem ? <ProblemBox problem={found.problem} again={found.again} /> : <Loading />}</div>;
  }
  const acquisition = found.data;
  return (
    <div class="page">
      <h1>
        {t("specimen")} {acquisition.specimen_id}
      </h1>
      {found.problem && <ProblemBox problem={found.problem} again={found.again} />}
      <p class="small">
        {moment(acquisition.created_at)} · {t("markers")} {acquisition.dictionary}, {t("edge", { mm: acquisition.edge_mm })}
        {acquisition.accession_number && <> · {t("accession")} {acquisition.accession_number}</>}
      </p>
      {acquisition.notes && <p>{acquisition.notes}</p>}
      {!acquisition.ready && <p class="box warning">{t("missing", { what: acquisition.missing.join(", ") })}</p>}
      {may("capture.write") && (
        <div class="row">
          <a class="button" href={href(["capture", id])}>
            {t("capture")}
          </a>
          {acquisition.ready && (
            <Action
              text={t("start")}
              kind="primary"
              testid="start-job"
              run={async () => {
                const job = await body(
                  api.POST("/v1/jobs", { body: { acquisition_id: id, settings: {}, priority: "routine" } as Schemas["JobRequest"] }),
                );
                go(["jobs", job.id]);
              }}
            />
          )}
        </div>
      )}
      <h2>{t("jobs")}</h2>
      <JobTable acquisition={id} />
      <h2>{t("files")}</h2>
      <PagedTable<Schemas["File"]>
        name={`files ${id}`}
        seconds={5}
        ask={async () => {
          const items = await body(api.GET("/v1/acquisitions/{acquisition_id}/files", { params: { path: { acquisition_id: id } } }));
          return { items: items as Schemas["File"][], next: null };
        }}
        head={[t("name"), t("role"), t("size"), t("verdict"), ""]}
        empty={t("noFiles")}
        row={(file, again) => (
          <>
            <td>
              <a href={`${BASE}/v1/acquisitions/${id}/files/${file.id}/content`} download={file.name}>
                {file.name}
              </a>
            </td>
            <td>{stateName(file.role)}</td>
            <td>{bytes(file.size)}</td>
            <td>
              <span class={stateClass(file.judgement.verdict)}>{stateName(file.judgement.verdict)}</span>
              {file.judgement.reason && (
                <div class="small">
                  {file.judgement.reason} {file.judgement.advice}
                </div>
              )}
            </td>
            <td>
              {may("capture.write") && (
                <Action
                  text={common("delete")}
                  kind="danger"
                  confirm={t("sureFile")}
                  done={again}
                  run={() =>
                    api.DELETE("/v1/acquisitions/{acquisition_id}/files/{file_id}", {
                      params: { path: { acquisition_id: id, file_id: file.id } },
                    })
                  }
                />
              )}
            </td>
          </>
        )}
      />
      {may("capture.write") && (
        <p>
          <Action
            text={t("remove")}
            kind="danger"
            confirm={t("sure")}
            done={() => go([])}
            run={() => api.DELETE("/v1/acquisitions/{acquisition_id}", { params: { path: { acquisition_id: id } } })}
          />
        </p>
      )}
    </div>
  );
}
