import { api, body, type Schemas } from "../api/client";
import { usePolled } from "../api/polling";
import { number } from "../i18n";
import { Loading, ProblemBox } from "../ui/boxes";
import { t } from "./texts";

type Report = Schemas["Report"];

const LIGHTS = { trusted: "good", doubtful: "fair", not_trusted: "bad", unverified: "fair" } as const;

/** The accuracy report: a traffic light with its reasons, the figures, the warnings. */
export function ReportSection({ job }: { job: string }) {
  const { data, problem, again } = usePolled(`report ${job}`, () =>
    body(api.GET("/v1/jobs/{job_id}/report", { params: { path: { job_id: job } } })),
  );
  if (data === undefined) return problem ? <ProblemBox problem={problem} again={again} /> : <Loading />;
  return <ReportFigures report={data} />;
}

export function ReportFigures({ report }: { report: Report }) {
  const verdict = report.certificate?.verdict ?? "unverified";
  const seen = report.certificate?.total_mm;
  const mm = (value: number | null | undefined, digits = 3) => (value == null ? "–" : number(value, digits));
  const reasons = new Set(report.certificate?.reasons ?? []);
  const sorted = [...report.warnings].sort((a, b) => Number(reasons.has(b.code)) - Number(reasons.has(a.code)));
  const figures: [string, string][] = [
    [t("sigma"), t("sigmaFigures", { median: mm(report.sigma_mm.median), p95: mm(report.sigma_mm.p95, 2) })],
    [t("corners"), t("median", { mm: mm(report.corner_3d_mm.median) })],
    [
      t("edge", { mm: mm(report.edge_length_mm.expected, 2) }),
      t("edgeFigures", { mean: mm(report.edge_length_mm.mean), std: mm(report.edge_length_mm.std) }),
    ],
    [t("coverage"), `${number(report.coverage.between_markers * 100, 1)} %`],
    [t("photos"), t("ofGiven", { used: report.photos.used.length, given: report.photos.given })],
  ];
  return (
    <section aria-labelledby="report" data-testid="report">
      <h2 id="report">{t("report")}</h2>
      <div class={`light ${LIGHTS[verdict]}`} data-testid="verdict" data-verdict={verdict}>
        <span class="lamp" aria-hidden="true" />
        <div>
          <strong>{t(verdict)}</strong>
          {seen && <div class="small">{t("seen", { median: mm(seen.median, 2), p95: mm(seen.p95, 2) })}</div>}
        </div>
      </div>
      <table>
        <tbody>
          {figures.map(([name, value]) => (
            <tr>
              <th scope="row">{name}</th>
              <td>{value}</td>
            </tr>
          ))}
        </tbody>
      </table>
      <h2>{t("warnings")}</h2>
      {sorted.length === 0 && <p>{t("noWarnings")}</p>}
      <ul>
        {sorted.map((warning) => (
          <li class={reasons.has(warning.code) ? LIGHTS[verdict] : ""}>
            {warning.message} <code class="small">{warning.code}</code>
          </li>
        ))}
      </ul>
      {report.photos.refused.length > 0 && (
        <details>
          <summary>
            {t("refusedPhotos")} ({report.photos.refused.length})
          </summary>
          <ul>
            {report.photos.refused.map((photo) => (
              <li>
                {photo.name}: {photo.reason}
              </li>
            ))}
          </ul>
        </details>
      )}
    </section>
  );
}
