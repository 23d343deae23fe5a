import { useState } from "preact/hooks";
import { api, body, type Schemas } from "../api/client";
import { asProblem, type Problem } from "../api/problem";
import { moment } from "../i18n";
import { ProblemBox } from "../ui/boxes";
import { fieldText } from "../ui/form";
import { PagedTable } from "../ui/paged";
import { t } from "./texts";

export function Projects() {
  const [round, setRound] = useState(0);
  const [problem, setProblem] = useState<Problem | null>(null);
  const submit = async (event: SubmitEvent): Promise<void> => {
    event.preventDefault();
    const form = event.currentTarget as HTMLFormElement;
    setProblem(null);
    try {
      await body(api.POST("/v1/projects", { body: { name: fieldText(form, "project") } }));
      form.reset();
      setRound((n) => n + 1);
    } catch (thrown) {
      setProblem(asProblem(thrown));
    }
  };
  return (
    <section>
      <h2>{t("projects")}</h2>
      <PagedTable<Schemas["Project"]>
        name={`projects ${round}`}
        ask={async () => ({ items: await projects(), next: null })}
        head={[t("name"), t("created")]}
        empty={t("none")}
        row={(project) => (
          <>
            <td>{project.name}</td>
            <td>{moment(project.created_at)}</td>
          </>
        )}
      />
      <form class="row" onSubmit={(event) => void submit(event)}>
        <input name="project" aria-label={t("newProject")} placeholder={t("newProject")} required maxLength={64} pattern="[A-Za-z0-9._\-]+" />
        <button type="submit">{t("create")}</button>
      </form>
      {problem && <ProblemBox problem={problem} />}
    </section>
  );
}

/** All projects. */
export async function projects(): Promise<Schemas["Project"][]> {
  const listed: unknown = await body(api.GET("/v1/projects"));
  return Array.isArray(listed) ? (listed as Schemas["Project"][]) : (listed as { items: Schemas["Project"][] }).items;
}
