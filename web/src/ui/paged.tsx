/** Lists that the service answers page by page. */
import type { ComponentChildren } from "preact";
import { useEffect, useState } from "preact/hooks";
import { usePolled } from "../api/polling";
import { asProblem, type Problem } from "../api/problem";
import { t } from "../i18n/common";
import { Loading, ProblemBox } from "./boxes";

export interface PageOf<T> {
  items: T[];
  next: string | null;
}

/**
 * Show a list: its first page, asked for again every `seconds`, and more at the end on request.
 *
 * `name` starts afresh when it changes, as with another filter.
 */
export function PagedTable<T extends { id: string | number }>(given: {
  name: string;
  ask: (after: string | undefined) => Promise<PageOf<T>>;
  head: readonly string[];
  row: (item: T, again: () => void) => ComponentChildren;
  empty: string;
  seconds?: number;
  testid?: string;
}) {
  const { name, ask, head, row, empty, seconds = 0, testid } = given;
  const first = usePolled(name, () => ask(undefined), seconds);
  const [more, setMore] = useState<{ items: T[]; next: string | null } | null>(null);
  const [problem, setProblem] = useState<Problem | null>(null);
  useEffect(() => setMore(null), [name]);

  if (first.data === undefined) {
    return first.problem ? <ProblemBox problem={first.problem} again={first.again} /> : <Loading />;
  }
  const known = new Set(first.data.items.map((item) => item.id));
  const items = [...first.data.items, ...(more?.items ?? []).filter((item) => !known.has(item.id))];
  const next = more ? more.next : first.data.next;
  const load = async (): Promise<void> => {
    try {
      const page = await ask(next ?? undefined);
      // What has moved from the first page to here while it was refreshed is kept.
      setMore({ items: [...(more?.items ?? first.data?.items ?? []), ...page.items], next: page.next });
      setProblem(null);
    } catch (thrown) {
      setProblem(asProblem(thrown));
    }
  };
  if (items.length === 0) return <p class="small">{empty}</p>;
  return (
    <>
      {first.problem && <ProblemBox problem={first.problem} again={first.again} />}
      <div class="scroll">
        <table data-testid={testid}>
          <thead>
            <tr>
              {head.map((text) => (
                <th scope="col">{text}</th>
              ))}
            </tr>
          </thead>
          <tbody>
            {items.map((item) => (
              <tr key={item.id}>{row(item, first.again)}</tr>
            ))}
          </tbody>
        </table>
      </div>
      {problem && <ProblemBox problem={problem} />}
      {next !== null && (
        <button type="button" onClick={() => void load()}>
          {t("more")}
        </button>
      )}
    </>
  );
}
