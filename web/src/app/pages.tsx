/** Which page an address shows; each is loaded when it is first opened. */
import type { ComponentType } from "preact";
import { useEffect, useState } from "preact/hooks";
import { asProblem, type Problem } from "../api/problem";
import { t } from "../i18n/common";
import { Loading, ProblemBox } from "../ui/boxes";
import { path } from "./route";
import { may } from "./session";

type Page = ComponentType<{ parts: readonly string[] }>;
type Module = { default: Page };

const PAGES: Record<string, () => Promise<Module>> = {
  "": () => import("../acquisitions/list-page"),
  acquisitions: () => import("../acquisitions/acquisition-page"),
  capture: () => import("../capture/capture-page"),
  jobs: () => import("../jobs/jobs-page"),
  results: () => import("../results/results-page"),
  view: () => import("../viewer/viewer-page"),
  admin: () => import("../admin/admin-page"),
};

/** Show the page of the address; `parts` are what follows its name. */
export function CurrentPage() {
  const [given = "", ...parts] = path.value;
  // An auditor sees the audit trail and nothing else.
  const name = given === "" && !may("result.read") && may("audit.read") ? "admin" : given;
  // Whatever every object has is no page.
  const load = Object.hasOwn(PAGES, name) ? PAGES[name] : undefined;
  if (load === undefined) return <p class="page">{t("notFound")}</p>;
  return <Loaded key={name} load={load} parts={parts} />;
}

function Loaded({ load, parts }: { load: () => Promise<Module>; parts: readonly string[] }) {
  const [page, setPage] = useState<{ show: Page } | null>(null);
  const [problem, setProblem] = useState<Problem | null>(null);
  const [round, setRound] = useState(0);
  useEffect(() => {
    let left = false;
    setProblem(null);
    load().then(
      (module) => !left && setPage({ show: module.default }),
      (thrown: unknown) => !left && setProblem(asProblem(thrown)),
    );
    return () => {
      left = true;
    };
  }, [load, round]);
  if (problem !== null) return <ProblemBox problem={problem} again={() => setRound((n) => n + 1)} />;
  return page === null ? <Loading /> : <page.show parts={parts} />;
}
