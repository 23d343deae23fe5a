import { useState } from "preact/hooks";
import { api, body, type Schemas } from "../api/client";
import { asProblem, type Problem } from "../api/problem";
import { moment } from "../i18n";
import { Action } from "../ui/action";
import { ProblemBox } from "../ui/boxes";
import { fieldText } from "../ui/form";
import { PagedTable } from "../ui/paged";
import { t } from "./texts";
import { copyText } from "../ui/browser";

const SCOPES = ["upload", "read", "label", "intraoperative", "audit", "admin"] as const;
type KeyRequest = Schemas["KeyRequest"];

/** Keys: listed, created (the key itself is shown once), revoked. */
export function Keys() {
  const [round, setRound] = useState(0);
  const [made, setMade] = useState<Schemas["NewKey"] | null>(null);
  return (
    <section>
      <h2>{t("keys")}</h2>
      <PagedTable<Schemas["Key"]>
        name={`keys ${round}`}
        testid="keys"
        ask={async () => ({ items: [...(await body(api.GET("/v1/keys")))].reverse(), next: null })}
        head={[t("name"), t("rights"), t("used"), t("ends"), t("state"), ""]}
        empty={t("none")}
        row={(key, again) => (
          <>
            <td>{key.name}</td>
            <td>{key.scopes.join(", ")}</td>
            <td>{key.last_used_at ? moment(key.last_used_at) : t("never")}</td>
            <td>{key.expires_at ? moment(key.expires_at) : ""}</td>
            <td>{stateOf(key)}</td>
            <td>
              {stateOf(key) === t("valid") && (
                <Action
                  text={t("revoke")}
                  kind="danger"
                  confirm={t("sureRevoke", { name: key.name })}
                  done={again}
                  run={() => api.DELETE("/v1/keys/{key_id}", { params: { path: { key_id: key.id } } })}
                />
              )}
            </td>
          </>
        )}
      />
      <NewKeyForm
        done={(key) => {
          setMade(key);
          setRound((n) => n + 1);
        }}
      />
      {made && <NewKeyBox made={made} />}
    </section>
  );
}

function stateOf(key: Schemas["Key"]): string {
  if (key.revoked_at !== null) return t("revoked");
  return key.expires_at !== null && Date.parse(key.expires_at) <= Date.now() ? t("expired") : t("valid");
}

function NewKeyBox({ made }: { made: Schemas["NewKey"] }) {
  const [copied, setCopied] = useState(false);
  return (
    <div class="box warning" role="status">
      <p>{t("shown")}</p>
      <p>
        <code data-testid="new-key">{made.key}</code>{" "}
        <button type="button" onClick={() => void copyText(made.key).then(setCopied)}>
          {copied ? t("copied") : t("copy")}
        </button>
      </p>
    </div>
  );
}

function NewKeyForm({ done }: { done: (key: Schemas["NewKey"]) => void }) {
  const [problem, setProblem] = useState<Problem | null>(null);
  const submit = async (event: SubmitEvent): Promise<void> => {
    event.preventDefault();
    const form = event.currentTarget as HTMLFormElement;
    const data = new FormData(form);
    const days = Number(fieldText(form, "days"));
    const project = fieldText(form, "project");
    const wanted: KeyRequest = {
      name: fieldText(form, "name"),
      scopes: data.getAll("scope") as KeyRequest["scopes"],
      ...(project ? { project } : {}),
      ...(days > 0 ? { expires_at: new Date(Date.now() + days * 86_400_000).toISOString() } : {}),
    };
    setProblem(null);
    try {
      done(await body(api.POST("/v1/keys", { body: wanted })));
      form.reset();
    } catch (thrown) {
      setProblem(asProblem(thrown));
    }
  };
  return (
    <details>
      <summary>{t("newKey")}</summary>
      <form onSubmit={(event) => void submit(event)}>
        <label>
          {t("name")} <input name="name" required maxLength={100} />
        </label>
        <fieldset class="row">
          <legend>{t("rights")}</legend>
          {SCOPES.map((scope) => (
            <label>
              <input type="checkbox" name="scope" value={scope} checked={scope === "read"} /> {scope}
            </label>
          ))}
        </fieldset>
        <label>
          {t("project")} <input name="project" maxLength={64} />
        </label>
        <label>
          {t("days")} <input name="days" type="number" min="1" max="3650" />
        </label>
        <button type="submit" class="primary">
          {t("create")}
        </button>
        {problem && <ProblemBox problem={problem} />}
      </form>
    </details>
  );
}
