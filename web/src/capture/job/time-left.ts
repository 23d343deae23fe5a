/** What is said of a running job: its stages, and the time left as people say it. */
import type { Schemas } from "../../api/client";
import { STAGES, type Stage } from "../../jobs/time-left";

export type Job = Schemas["Job"];

/** Round as people do: by 5 s below a minute, by half a minute below five, then by minutes. */
export function rounded(seconds: number): number {
  const grain = seconds < 60 ? 5 : seconds < 300 ? 30 : 60;
  return Math.max(Math.ceil(seconds / grain) * grain, 5);
}

export type StageState = "done" | "now" | "failed" | "ahead";

/** What each stage of a job is at. */
export function stagesOf(job: Pick<Job, "state" | "stage">): [Stage, StageState][] {
  const at = job.state === "succeeded" ? STAGES.length : job.stage === null ? -1 : STAGES.indexOf(job.stage);
  const here = job.state === "failed" ? "failed" : "now";
  return STAGES.map((stage, n) => [stage, n < at ? "done" : n === at ? here : "ahead"]);
}
