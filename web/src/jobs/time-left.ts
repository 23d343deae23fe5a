/** How long a job will still take, from usual shares of its stages. */
import type { Schemas } from "../api/client";

export const STAGES = ["reconstruct", "adjust", "render", "register"] as const;
export type Stage = (typeof STAGES)[number];

/** Share of the whole that each stage takes on the sample and on full-size phantoms (docs/performance-tables.md). */
const SHARES: Record<Stage, number> = { reconstruct: 0.34, adjust: 0.42, render: 0.03, register: 0.21 };

/** Share of a job that is done, 0 to 1. */
export function doneShare(stage: Stage | null, progress: number): number {
  let done = 0;
  for (const name of STAGES) {
    if (name === stage) return done + SHARES[name] * Math.min(Math.max(progress, 0), 1);
    done += SHARES[name];
  }
  return 0;
}

/** Seconds left, or null while too little is done to tell. */
export function secondsLeft(job: Pick<Schemas["Job"], "stage" | "progress" | "started_at">, now: number): number | null {
  if (job.started_at === null) return null;
  const done = doneShare(job.stage, job.progress);
  const spent = (now - Date.parse(job.started_at)) / 1000;
  if (done < 0.1 || spent < 2) return null;
  return Math.max(0, Math.round((spent * (1 - done)) / done));
}
