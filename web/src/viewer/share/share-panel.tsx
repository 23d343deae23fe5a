/** Links that show this cloud, and nothing else, to people without a key. */
import { useId, useState } from "preact/hooks";
import { api, body, type Schemas } from "../../api/client";
import { usePolled } from "../../api/polling";
import { asProblem, type Problem } from "../../api/problem";
import { moment, texts } from "../../i18n";
import { Action } from "../../ui/action";
import { ProblemBox } from "../../ui/boxes";
import { fieldText } from "../../ui/form";
import type { PanelProps } from "../viewer";
import { encode } from "../view-state";
import { copyText, randomId } from "../../ui/browser";

type Share = Schemas["Share"];

const en = {
  hint: "Whoever has the link sees this cloud until the link ends, and nothing else. It opens at the present view.",
  name: "For whom (no patient’s name)",
  days: "Ends after",
  day: "one day|{n} days",
  create: "Make a link",
  link: "The link; it is shown this once",
  copy: "Copy",
  copied: "Copied.",
  none: "There is no link.",
  list: "Links",
  ends: "ends {when}",
  ended: "ended",
  used: "last used {when}",
  unused: "not used yet",
  revoke: "Revoke",
  sure: "Revoke the link for “{name}”? It stops working at once.",
};
const it: typeof en = {
  hint: "Chi ha il collegamento vede questa nuvola finché non scade, e nient’altro. Si apre sulla vista attuale.",
  name: "Per chi (nessun nome di paziente)",
  days: "Scade dopo",
  day: "un giorno|{n} giorni",
  create: "Crea un collegamento",
  link: "Il collegamento; viene mostrato solo ora",
  copy: "Copia",
  copied: "Copiato.",
  none: "Non ci sono collegamenti.",
  list: "Collegamenti",
  ends: "scade {when}",
  ended: "terminato",
  used: "usato l’ultima volta {when}",
  unused: "non ancora usato",
  revoke: "Revoca",
  sure: "Revocare il collegamento per “{name}”? Smette subito di funzionare.",
};
const t = texts({ en, it });
const DAYS = [1, 7, 30, 90] as const;
const DAY_MS = 86_400_000;

export default function SharePanel({ model }: PanelProps) {
  const cloud_id = model.info.id;
  const [link, setLink] = useState<string | null>(null);
  const [problem, setProblem] = useState<Problem | null>(null);
  const [busy, setBusy] = useState(false);
  const shares = usePolled(`shares ${cloud_id}`, () => body(api.GET("/v1/clouds/{cloud_id}/shares", { params: { path: { cloud_id } } })));
  const id = useId();

  const create = async (event: SubmitEvent): Promise<void> => {
    event.preventDefault();
    const form = event.currentTarget as HTMLFormElement;
    const days = Number(fieldText(form, "days"));
    setBusy(true);
    setProblem(null);
    try {
      const made = await body(
        api.POST("/v1/clouds/{cloud_id}/shares", {
          params: { path: { cloud_id }, header: { "idempotency-key": randomId() } },
          // A minute less: the service counts the days by its own clock.
          body: { name: fieldText(form, "name"), expires_at: new Date(Date.now() + days * DAY_MS - 60_000).toISOString() },
        }),
      );
      const view = model.view.value;
      const state = { ...model.state.value, camera: view ? view.cameraState : model.state.value.camera };
      const query = encode(state, model.first).toString();
      setLink(new URL(`#/shared/${made.token}${query ? `?${query}` : ""}`, document.baseURI).href);
      shares.again();
    } catch (thrown) {
      setProblem(asProblem(thrown));
    } finally {
      setBusy(false);
    }
  };

  return (
    <>
      <form onSubmit={(event) => void create(event)}>
        <p class="small">{t("hint")}</p>
        <label for={`${id}-name`}>{t("name")}</label>
        <input id={`${id}-name`} name="name" type="text" required maxLength={100} data-testid="share-name" />
        <label for={`${id}-days`}>{t("days")}</label>
        <select id={`${id}-days`} name="days" data-testid="share-days">
          {DAYS.map((n) => (
            <option value={n} selected={n === 7}>
              {t("day", { n })}
            </option>
          ))}
        </select>
        <button type="submit" class="primary" disabled={busy} data-testid="share-create">
          {t("create")}
        </button>
      </form>
      {problem && <ProblemBox problem={problem} />}
      {link !== null && <NewLink link={link} />}
      <h2>{t("list")}</h2>
      {shares.problem && <ProblemBox problem={shares.problem} again={shares.again} />}
      {shares.data?.length === 0 && <p class="small">{t("none")}</p>}
      <ul class="legend" data-testid="shares">
        {shares.data?.map((share) => (
          <ShareLine key={share.id} share={share} onRevoked={shares.again} />
        ))}
      </ul>
    </>
  );
}

function NewLink({ link }: { link: string }) {
  const [copied, setCopied] = useState(false);
  const id = useId();
  return (
    <div class="box" role="status">
      <label for={id}>{t("link")}</label>
      <input id={id} type="text" readOnly value={link} data-testid="share-link" onFocus={(event) => event.currentTarget.select()} />
      <button type="button" onClick={() => void copyText(link).then(setCopied)}>
        {copied ? t("copied") : t("copy")}
      </button>
    </div>
  );
}

function ShareLine({ share, onRevoked }: { share: Share; onRevoked: () => void }) {
  const over = share.revoked_at !== null || new Date(share.expires_at) < new Date();
  const revoke = (): Promise<unknown> =>
    api.DELETE("/v1/clouds/{cloud_id}/shares/{share_id}", {
      params: { path: { cloud_id: share.cloud_id, share_id: share.id } },
    });
  return (
    <li data-testid="share" data-ended={String(over)}>
      <span class="curve-text">
        {share.name}
        <span class="small block">
          {over ? t("ended") : t("ends", { when: moment(share.expires_at) })},{" "}
          {share.last_used_at ? t("used", { when: moment(share.last_used_at) }) : t("unused")}
        </span>
      </span>
      {!over && (
        <Action text={t("revoke")} kind="danger" confirm={t("sure", { name: share.name })} run={revoke} done={onRevoked} testid="share-revoke" />
      )}
    </li>
  );
}
