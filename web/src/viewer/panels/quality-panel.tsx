/** Why the light has its colour: figures and warnings of the report. */
import { ReportFigures } from "../../jobs/report-section";
import type { PanelProps } from "../viewer";
import { reportOf } from "./verdict";

export default function QualityPanel({ model }: PanelProps) {
  const report = reportOf(model);
  return report ? <ReportFigures report={report} /> : null;
}
