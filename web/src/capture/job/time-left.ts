/** How far a job is as a whole, and how long it may still take. */
import type { Schemas } from "../../api/client";

export type Job = Schemas["Job"];
export const STAGES = ["reconstruct", "adjust", "render", "register"] as const;
export type Stage = (typeof STAGES)[number];

/** Shares of a run's time, as measured on the sample: 7.7, 10.2, 0.1 and 4.1 s on two cores. */
const SHARES: Record<Stage, number> = { reconstruct: 0.35, adjust: 0.45, render: 0.01, register: 0.19 };
/** Before this share is done nothing is said of the time left. */
const LEAST_DONE = 0.08;

/** The share of the whole run that is done, 0 to 1. */
export function done(stage: Stage | null, progress: number): number {
  if (stage === null) return 0;
  const before = STAGES.slice(0, STAGES.indexOf(stage)).reduce((sum, each) => sum + SHARES[each], 0);
  return Math.min(before + SHARES[stage] * Math.min(Math.max(progress, 0), 1), 1);
}

/** Seconds left, from those since the start; null while that would be a guess. */
export function secondsLeft(share: number, elapsed: number): number | null {
  if (share < LEAST_DONE || elapsed <= 0) return null;
  return Math.max(Math.round((elapsed * (1 - share)) / share), 0);
}

/** Round as people do: by 5 s below a minute, by half a minute below five, then by minutes. */
export function rounded(seconds: number): number {
  const grain = seconds < 60 ? 5 : seconds < 300 ? 30 : 60;
  return Math.max(Math.ceil(seconds / grain) * grain, 5);
}

export type StageState = "done" | "now" | "ahead";

/** What each stage of a job is at. */
export function stagesOf(job: Pick<Job, "state" | "stage">): [Stage, StageState][] {
  const at = job.state === "succeeded" ? STAGES.length : job.stage === null ? -1 : STAGES.indexOf(job.stage);
  return STAGES.map((stage, n) => [stage, n < at ? "done" : n === at ? "now" : "ahead"]);
}
