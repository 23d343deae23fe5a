import { api, body, fetched, type Schemas } from "../api/client";
import { usePolled } from "../api/polling";
import { Problem } from "../api/problem";
import { isPerson, may } from "../app/session";
import { bytes, moment, number } from "../i18n";
import { stateName, type StateKey } from "../i18n/states";
import { ProblemBox } from "../ui/boxes";
import { PagedTable } from "../ui/paged";
import { Keys } from "./keys";
import { byLabel, parseMetrics, valueOf } from "./metrics";
import { Projects } from "./projects";
import { t } from "./texts";

/** Keys, projects, workers, queue and storage, for administrators; the audit trail, for auditors too. */
export default function AdminPage() {
  if (!may("audit.read")) {
    const lacking = isPerson() ? { permission: "key.manage" } : { scope: "admin" };
    const refused = new Problem("forbidden", "This is for administrators.", "", 403, lacking);
    return (
      <div class="page">
        <ProblemBox problem={refused} />
      </div>
    );
  }
  return (
    <div class="page">
      {may("key.manage") && <h1>{t("title")}</h1>}
      {may("service.watch") && <ServiceState />}
      {may("key.manage") && <Keys />}
      {may("project.manage") && <Projects />}
      <h2>{t("audit")}</h2>
      <PagedTable<Schemas["AuditEntry"]>
        name="audit"
        testid="audit"
        ask={(after) => body(api.GET("/v1/audit", { params: { query: { limit: 50, ...(after ? { after: Number(after) } : {}) } } }))}
        head={[t("at"), t("action"), t("target"), t("who")]}
        empty={t("none")}
        row={(entry) => (
          <>
            <td>{moment(entry.at)}</td>
            <td>{entry.action}</td>
            <td>
              <code class="small">{entry.target}</code>
            </td>
            <td>
              <code class="small">{entry.key_id}</code>
            </td>
          </>
        )}
      />
    </div>
  );
}

function ServiceState() {
  const { data, problem, again } = usePolled(
    "service",
    async (signal) => {
      const [ready, text] = await Promise.all([
        body(api.GET("/readyz", { signal })),
        fetched("/metrics", { signal }).then((answer) => answer.text()),
      ]);
      return { ready, samples: parseMetrics(text) };
    },
    5,
  );
  const samples = data?.samples ?? [];
  const free = valueOf(samples, "specimap_storage_free_bytes");
  const rows: [string, string][] = [
    [t("workers"), number(data?.ready.workers ?? 0)],
    [
      t("jobs"),
      [...byLabel(samples, "specimap_jobs", "state")]
        .map(([state, count]) => `${stateName(state as StateKey)}: ${number(count)}`)
        .join(" · "),
    ],
    [t("waiting"), `${number(valueOf(samples, "specimap_queue_wait_seconds") ?? 0)} s`],
    [
      t("storage"),
      [...byLabel(samples, "specimap_storage_use_bytes", "kind")].map(([kind, size]) => `${kind}: ${bytes(size)}`).join(" · "),
    ],
    [t("free"), free === undefined ? "–" : bytes(free)],
  ];
  return (
    <section>
      <h2>{t("service")}</h2>
      {problem && <ProblemBox problem={problem} again={again} />}
      {data && (
        <table>
          <tbody>
            {rows.map(([name, value]) => (
              <tr>
                <th scope="row">{name}</th>
                <td>{value}</td>
              </tr>
            ))}
          </tbody>
        </table>
      )}
    </section>
  );
}
