import { useEffect, useRef, useState } from "preact/hooks";
import { asProblem, type Problem } from "./problem";

export interface Polled<T> {
  data: T | undefined;
  problem: Problem | null;
  /** Ask now. */
  again: () => void;
}

/**
 * Ask for something now and every `seconds` while the page is in sight; 0 asks once.
 *
 * What was known stays when a later answer fails, with the problem beside it. `key` starts afresh when it changes.
 */
export function usePolled<T>(key: string, ask: (signal: AbortSignal) => Promise<T>, seconds = 0): Polled<T> {
  const [state, setState] = useState<{ key: string; data?: T; problem: Problem | null }>({ key, problem: null });
  const asking = useRef(ask);
  asking.current = ask;
  const [round, setRound] = useState(0);
  useEffect(() => {
    const ended = new AbortController();
    let timer: ReturnType<typeof setTimeout> | undefined;
    const once = async (): Promise<void> => {
      let wait = seconds;
      try {
        const data = await asking.current(ended.signal);
        if (!ended.signal.aborted) setState({ key, data, problem: null });
      } catch (thrown) {
        if (ended.signal.aborted) return;
        const problem = asProblem(thrown);
        wait = Math.max(wait, problem.retryAfter ?? 0, problem.status === 0 || problem.status >= 500 ? 3 : 0);
        setState((before) => ({ key, data: before.key === key ? before.data : undefined, problem }));
      }
      if (wait > 0 && !ended.signal.aborted) timer = setTimeout(tick, wait * 1000);
    };
    const tick = (): void => {
      if (document.hidden) timer = setTimeout(tick, 1000);
      else void once();
    };
    void once();
    return () => {
      ended.abort();
      clearTimeout(timer);
    };
  }, [key, seconds, round]);
  const now = state.key === key ? state : { data: undefined, problem: null };
  return { data: now.data, problem: now.problem, again: () => setRound((n) => n + 1) };
}
