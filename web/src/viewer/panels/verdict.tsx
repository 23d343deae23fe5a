/** The report's verdict on the result, as a light with its name. */
import type { Schemas } from "../../api/client";
import { t } from "../texts";
import type { PanelProps } from "../viewer";
import type { ViewerModel } from "../viewer-model";

export type Report = Schemas["Report"];
const LIGHTS = { trusted: "good", doubtful: "fair", not_trusted: "bad", unverified: "fair" } as const;

/** The report in the cloud's attributes; undefined until they have been read. */
export function reportOf(model: ViewerModel): Report | undefined {
  // The attributes come with the cloud.
  return model.cloud.value ? (model.loader.attributes.report as Report | undefined) : undefined;
}

export function VerdictLamp({ model }: PanelProps) {
  const report = reportOf(model);
  if (!report) return null;
  const verdict = report.certificate?.verdict ?? "unverified";
  return (
    <div class={`verdict-lamp ${LIGHTS[verdict]}`} data-testid="viewer-verdict" data-verdict={verdict}>
      <span class="lamp" aria-hidden="true" />
      <strong>{t(verdict)}</strong>
      {report.warnings.length > 0 && <span class="small">{t("warnings", { n: report.warnings.length })}</span>}
    </div>
  );
}
