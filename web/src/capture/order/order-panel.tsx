/** The order of an acquisition: looked up in the worklist, or entered by hand. Asked for when somebody opens it. */
import { useState } from "preact/hooks";
import { api, body, type Schemas } from "../../api/client";
import { asProblem, type Problem } from "../../api/problem";
import { may } from "../../app/session";
import { ProblemBox } from "../../ui/boxes";
import { fieldText } from "../../ui/form";
import { t } from "./texts";

type Study = Schemas["StudyContext"];
type Orders = Schemas["Orders"];

export function OrderPanel({ acquisition }: { acquisition: string }) {
  const [study, setStudy] = useState<Study | null>(null);
  const [orders, setOrders] = useState<Orders | null>(null);
  const [problem, setProblem] = useState<Problem | null>(null);
  const [busy, setBusy] = useState(false);
  if (!may("study.manage")) return null;
  const params = { path: { acquisition_id: acquisition } };

  const attempt = async (work: () => Promise<void>): Promise<void> => {
    setBusy(true);
    setProblem(null);
    try {
      await work();
    } catch (thrown) {
      setProblem(asProblem(thrown));
    } finally {
      setBusy(false);
    }
  };

  const load = (): Promise<void> =>
    attempt(async () => {
      try {
        const known = await body(api.GET("/v1/acquisitions/{acquisition_id}/study", { params }));
        setStudy(known.study);
      } catch (thrown) {
        if (asProblem(thrown).code !== "not_found") throw thrown;
        setStudy(null);
      }
    });

  const choose = (wanted: Partial<Study>): Promise<void> =>
    attempt(async () => {
      // What is left out is empty; the types of the contract take fields with a default for required ones.
      const known = await body(api.PUT("/v1/acquisitions/{acquisition_id}/study", { params, body: wanted as Study }));
      setStudy(known.study);
      setOrders(null);
    });

  const remove = (): Promise<void> =>
    attempt(async () => {
      await api.DELETE("/v1/acquisitions/{acquisition_id}/study", { params });
      setStudy(null);
    });

  const submit = (event: SubmitEvent): void => {
    event.preventDefault();
    const form = event.currentTarget as HTMLFormElement;
    const asked = { accession_number: fieldText(form, "accession"), patient_id: fieldText(form, "patient") };
    const byHand = (event.submitter as HTMLButtonElement | null)?.value === "hand";
    if (byHand) {
      const birth = fieldText(form, "birth");
      void choose({ ...asked, patient_name: fieldText(form, "name"), patient_birth_date: birth || null });
      return;
    }
    void attempt(async () => setOrders(await body(api.POST("/v1/orders/search", { body: { ...asked, station: "" } }))));
  };

  return (
    <details class="order" data-testid="order" onToggle={(event) => event.currentTarget.open && void load()}>
      <summary>{t("title")}</summary>
      <p class="small">{t("hint")}</p>
      <p role="status" data-testid="order-chosen">
        {study ? t("chosen", { patient: nameOf(study), accession: study.accession_number || "–" }) : t("none")}
      </p>
      {study && (
        <button type="button" disabled={busy} onClick={() => void remove()} data-testid="order-remove">
          {t("remove")}
        </button>
      )}
      <form onSubmit={submit} autocomplete="off">
        <label for="order-accession">{t("accession")}</label>
        <input id="order-accession" name="accession" maxLength={16} />
        <label for="order-patient">{t("patientId")}</label>
        <input id="order-patient" name="patient" maxLength={64} />
        <label for="order-name">{t("patientName")}</label>
        <input id="order-name" name="name" maxLength={64} />
        <label for="order-birth">{t("birth")}</label>
        <input id="order-birth" name="birth" type="date" />
        <p class="row">
          <button type="submit" class="primary" value="find" disabled={busy} data-testid="order-find">
            {t("find")}
          </button>
          <button type="submit" value="hand" disabled={busy} data-testid="order-hand">
            {t("byHand")}
          </button>
        </p>
      </form>
      {orders && <Found orders={orders} busy={busy} choose={(wanted) => void choose(wanted)} />}
      {problem && <ProblemBox problem={problem} />}
    </details>
  );
}

function Found({ orders, busy, choose }: { orders: Orders; busy: boolean; choose: (study: Study) => void }) {
  const n = orders.orders.length;
  return (
    <div aria-live="polite">
      <p>{n ? t("found", { n }) : t("nothing")}</p>
      {orders.more && <p class="small">{t("more")}</p>}
      <ul>
        {orders.orders.map((order) => (
          <li class="row">
            <span class="fill">
              {nameOf(order.study)}, {order.study.patient_birth_date ?? "–"}, {order.study.accession_number || "–"}, {order.description}
            </span>
            <button type="button" disabled={busy} onClick={() => choose(order.study)} data-testid="order-choose">
              {t("choose")}
            </button>
          </li>
        ))}
      </ul>
    </div>
  );
}

/** A name as people write it. */
function nameOf(study: Study): string {
  const [family = "", given = ""] = study.patient_name.split("^");
  return [family, given].filter(Boolean).join(", ") || t("nobody");
}
