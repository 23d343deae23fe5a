/** A button for something that the service does: disabled meanwhile, with its refusal below. */
import { useState } from "preact/hooks";
import { asProblem, type Problem } from "../api/problem";
import { ProblemBox } from "./boxes";

export function Action(given: {
  text: string;
  run: () => Promise<unknown>;
  done?: (() => void) | undefined;
  /** Asked before, where it cannot be undone. */
  confirm?: string;
  kind?: "primary" | "danger" | undefined;
  testid?: string;
}) {
  const [busy, setBusy] = useState(false);
  const [problem, setProblem] = useState<Problem | null>(null);
  const click = async (): Promise<void> => {
    if (given.confirm !== undefined && !window.confirm(given.confirm)) return;
    setBusy(true);
    setProblem(null);
    try {
      await given.run();
      given.done?.();
    } catch (thrown) {
      setProblem(asProblem(thrown));
    } finally {
      setBusy(false);
    }
  };
  return (
    <>
      <button type="button" class={given.kind} disabled={busy} data-testid={given.testid} onClick={() => void click()}>
        {given.text}
      </button>
      {problem && <ProblemBox problem={problem} />}
    </>
  );
}
