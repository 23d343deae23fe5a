/** A job followed as it runs: by its events where they come, else by asking. */
import { useEffect, useRef } from "preact/hooks";
import { api, BASE, body } from "../../api/client";
import { usePolled, type Polled } from "../../api/polling";
import type { Job } from "./time-left";

const FINAL = new Set<Job["state"]>(["succeeded", "failed", "cancelled"]);
/** Seconds between questions beside the events: a stream may die unnoticed behind a proxy. */
const BESIDE = 5;

export const isFinal = (job: Job): boolean => FINAL.has(job.state);

/** The jobs of an acquisition, newest first; `again` is called at every event of the newest. */
export function useJobs(acquisition_id: string): Polled<readonly Job[]> {
  const asked = usePolled<readonly Job[]>(
    `jobs:${acquisition_id}`,
    async (signal) => {
      const params = { query: { acquisition_id, limit: 10 } };
      return (await body(api.GET("/v1/jobs", { params, signal }))).items;
    },
    BESIDE,
  );
  const newest = asked.data?.[0];
  const followed = newest && !isFinal(newest) ? newest.id : null;
  const { again } = asked;
  const tell = useLatest(again);
  useEffect(() => {
    if (followed === null) return;
    const source = new EventSource(`${BASE}/v1/jobs/${followed}/events`);
    let timer: ReturnType<typeof setTimeout> | undefined;
    const soon = (): void => {
      // Events come in bursts, and from the first one on: one question answers all.
      timer ??= setTimeout(() => {
        timer = undefined;
        tell.current();
      }, 300);
    };
    for (const type of ["state", "progress"]) source.addEventListener(type, soon);
    return () => {
      clearTimeout(timer);
      source.close();
    };
  }, [followed, tell]);
  return asked;
}

function useLatest<T>(value: T): { current: T } {
  const kept = useRef(value);
  kept.current = value;
  return kept;
}
