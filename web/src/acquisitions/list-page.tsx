import { useState } from "preact/hooks";
import { api, body, type Schemas } from "../api/client";
import { go, href, query } from "../app/route";
import { may } from "../app/session";
import { moment } from "../i18n";
import { t as common } from "../i18n/common";
import { PagedTable } from "../ui/paged";
import { t } from "./texts";

export default function AcquisitionsPage() {
  const wanted = query.value.get("specimen") ?? "";
  const [typed, setTyped] = useState(wanted);
  return (
    <div class="page">
      <h1>{t("title")}</h1>
      <div class="row">
        {may("capture.write") && (
          <a class="button primary" href={href(["capture"])} data-testid="new-acquisition">
            {t("new")}
          </a>
        )}
        <form
          class="row"
          role="search"
          onSubmit={(event) => {
            event.preventDefault();
            go([], typed.trim() ? { specimen: typed.trim() } : {});
          }}
        >
          <input
            type="search"
            aria-label={t("searchHint")}
            placeholder={t("searchHint")}
            maxLength={64}
            value={typed}
            onInput={(event) => setTyped(event.currentTarget.value)}
          />
          <button type="submit">{common("search")}</button>
        </form>
      </div>
      <PagedTable<Schemas["Acquisition"]>
        name={`acquisitions ${wanted}`}
        testid="acquisitions"
        seconds={10}
        ask={(after) =>
          body(
            api.GET("/v1/acquisitions", {
              params: { query: { limit: 50, ...(after ? { after } : {}), ...(wanted ? { specimen_id: wanted } : {}) } },
            }),
          )
        }
        head={[t("specimen"), t("created"), t("photos"), t("cube"), t("ready")]}
        empty={t("none")}
        row={(item) => (
          <>
            <td>
              <a href={href(["acquisitions", item.id])}>{item.specimen_id}</a>
              {item.accession_number && <div class="small">{item.accession_number}</div>}
            </td>
            <td>{moment(item.created_at)}</td>
            <td>{item.files.photos}</td>
            <td>{item.files.cube ? t("yes") : t("no")}</td>
            <td class={item.ready ? "good" : ""}>{item.ready ? t("yes") : t("no")}</td>
          </>
        )}
      />
    </div>
  );
}
