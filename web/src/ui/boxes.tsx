/** Small parts that every page uses. */
import type { ComponentChildren } from "preact";
import { useErrorBoundary } from "preact/hooks";
import { asProblem, type Problem } from "../api/problem";
import { t } from "../i18n/common";

export function Loading() {
  return (
    <p class="loading" role="status">
      {t("loading")}
    </p>
  );
}

/** A refusal in the service's words, with its advice and code; the loss of the connection in ours. */
export function ProblemBox({ problem, again }: { problem: Problem; again?: (() => void) | undefined }) {
  const details = problem.details as { scope?: unknown; permission?: unknown };
  const text =
    problem.status === 0 && problem.code === "network_lost"
      ? t("networkLost")
      : problem.code === "forbidden" && typeof details.scope === "string"
        ? t("noRight", { scope: details.scope })
        : problem.code === "forbidden" && typeof details.permission === "string"
          ? t("noPermission", { permission: details.permission })
          : problem.message;
  return (
    <div class="box problem" role="alert">
      <p>{text}</p>
      {problem.advice && <p>{problem.advice}</p>}
      <p class="small">
        <code>{problem.code}</code>
      </p>
      {again && (
        <button type="button" onClick={again}>
          {t("retry")}
        </button>
      )}
    </div>
  );
}

/** Show what went wrong in a part of the page instead of an empty one. */
export function Guarded({ children }: { children: ComponentChildren }) {
  const [error, reset] = useErrorBoundary() as [unknown, () => void];
  if (error === undefined) return <>{children}</>;
  return <ProblemBox problem={asProblem(error)} again={reset} />;
}

/** A bar of progress, 0 to 1. */
export function Progress({ value, label }: { value: number; label: string }) {
  return <progress max={1} value={value} aria-label={label} />;
}
