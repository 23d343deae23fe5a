import { useState } from "preact/hooks";
import { api, BASE, body, type Schemas } from "../api/client";
import { go, href, query } from "../app/route";
import { bytes, moment, number, texts } from "../i18n";
import { t as common } from "../i18n/common";
import { PagedTable } from "../ui/paged";

const en = {
  title: "Results",
  none: "There is no result yet.",
  preview: "Preview",
  made: "Made",
  points: "Points",
  bands: "Bands",
  size: "Size",
  open: "Open in 3D",
  report: "Report",
  searchHint: "Specimen id",
};
const it: typeof en = {
  title: "Risultati",
  none: "Non c’è ancora nessun risultato.",
  preview: "Anteprima",
  made: "Creato",
  points: "Punti",
  bands: "Bande",
  size: "Dimensione",
  open: "Apri in 3D",
  report: "Rapporto",
  searchHint: "Id del campione",
};
const t = texts({ en, it });

/** All finished clouds, with small pictures. */
export default function ResultsPage() {
  const wanted = query.value.get("specimen") ?? "";
  const [typed, setTyped] = useState(wanted);
  return (
    <div class="page">
      <h1>{t("title")}</h1>
      <form
        class="row"
        role="search"
        onSubmit={(event) => {
          event.preventDefault();
          go(["results"], typed.trim() ? { specimen: typed.trim() } : {});
        }}
      >
        <input
          type="search"
          aria-label={t("searchHint")}
          placeholder={t("searchHint")}
          maxLength={200}
          value={typed}
          onInput={(event) => setTyped(event.currentTarget.value)}
        />
        <button type="submit">{common("search")}</button>
      </form>
      <PagedTable<Schemas["CloudSummary"]>
        name={`clouds ${wanted}`}
        testid="results"
        seconds={10}
        ask={(after) =>
          body(
            api.GET("/v1/clouds", {
              params: { query: { limit: 25, ...(after ? { after } : {}), ...(wanted ? { specimen_id: wanted } : {}) } },
            }),
          )
        }
        head={[t("preview"), t("made"), t("points"), t("bands"), t("size"), ""]}
        empty={t("none")}
        row={(cloud) => (
          <>
            <td>
              <a href={href(["view", cloud.id])} tabIndex={-1} aria-hidden="true">
                <img
                  class="thumbnail"
                  src={`${BASE}/v1/clouds/${cloud.id}/previews/rgb.png`}
                  alt=""
                  loading="lazy"
                  width="120"
                />
              </a>
            </td>
            <td>
              <a href={href(["view", cloud.id])}>{moment(cloud.created_at)}</a>
            </td>
            <td>{number(cloud.points)}</td>
            <td>{cloud.bands}</td>
            <td>{bytes(cloud.size)}</td>
            <td>
              <a href={href(["jobs", cloud.job_id])}>{t("report")}</a>
            </td>
          </>
        )}
      />
    </div>
  );
}
