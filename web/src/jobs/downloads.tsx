import { api, BASE, body, type Schemas } from "../api/client";
import { usePolled } from "../api/polling";
import { may } from "../app/session";
import { bytes } from "../i18n";
import { Action } from "../ui/action";
import { ProblemBox } from "../ui/boxes";
import { t } from "./texts";

const FORMATS: { format: Schemas["FileFormat"]; what: string; of?: "mesh" | "points" }[] = [
  { format: "pdf", what: "PDF" },
  { format: "html", what: "HTML" },
  { format: "mesh-ply", what: "PLY", of: "mesh" },
  { format: "mesh-stl", what: "STL", of: "mesh" },
  { format: "mesh-glb", what: "GLB", of: "mesh" },
  { format: "ply", what: "PLY", of: "points" },
  { format: "las", what: "LAS" },
  { format: "csv", what: "CSV" },
  { format: "npz", what: "NPZ" },
  { format: "envi", what: "ENVI" },
  { format: "zarr", what: "Zarr (ZIP)" },
];

/** The result in other formats: made on request, then fetched. */
export function Downloads({ cloud }: { cloud: string }) {
  const at = { params: { path: { cloud_id: cloud } } };
  const made = usePolled(`exports ${cloud}`, () => body(api.GET("/v1/clouds/{cloud_id}/exports", at)), 2);
  const known = new Map((made.data ?? []).map((item) => [item.format, item]));
  return (
    <section>
      <h2>{t("downloads")}</h2>
      {made.problem && <ProblemBox problem={made.problem} again={made.again} />}
      <div class="row">
        {FORMATS.map(({ format, what: name, of }) => {
          const what = of ? `${name} (${t(of)})` : name;
          const item = known.get(format);
          if (item?.state === "succeeded") {
            return (
              <a class="button" href={`${BASE}/v1/clouds/${cloud}/exports/${format}/content`} download="">
                {t("download")} {what} {item.size !== null && <>&nbsp;({bytes(item.size)})</>}
              </a>
            );
          }
          if (item?.state === "queued" || item?.state === "running") {
            return (
              <span role="status">
                {what} {t("making")}
              </span>
            );
          }
          if (!may("result.read")) return null;
          return (
            <Action
              text={`${t("prepare")} ${what}`}
              done={made.again}
              run={() => api.POST("/v1/clouds/{cloud_id}/exports/{format}", { params: { path: { cloud_id: cloud, format } } })}
            />
          );
        })}
      </div>
    </section>
  );
}
