import { useState } from "preact/hooks";
import { api, body, type Schemas } from "../api/client";
import { asProblem, type Problem } from "../api/problem";
import { go } from "../app/route";
import { may, session } from "../app/session";
import { ProblemBox } from "../ui/boxes";
import { Barcode } from "./barcode";
import { PATTERN } from "./specimen-id";
import { t } from "./texts";
import { randomId } from "../ui/browser";

type Request = Schemas["AcquisitionRequest"];
type Dictionary = NonNullable<Request["dictionary"]>;

const DICTIONARIES: readonly Dictionary[] = [
  ...([4, 5, 6, 7] as const).flatMap((bits) => ([50, 100, 250, 1000] as const).map((ids) => `DICT_${bits}X${bits}_${ids}` as Dictionary)),
  ...(["16h5", "25h9", "36h10", "36h11"] as const).map((name) => `DICT_APRILTAG_${name}` as Dictionary),
  "DICT_ARUCO_MIP_36h12",
  "DICT_ARUCO_ORIGINAL",
];
const EDGE_MM = 6.8;
/** The cards of a hospital are always the same: those used last are offered. */
const KEPT = "specimap.markers";

function lastMarkers(): { edge: number; dictionary: Dictionary } {
  try {
    const { edge, dictionary } = JSON.parse(localStorage.getItem(KEPT) ?? "{}") as { edge?: unknown; dictionary?: unknown };
    return {
      edge: typeof edge === "number" ? edge : EDGE_MM,
      dictionary: DICTIONARIES.find((name) => name === dictionary) ?? "DICT_4X4_50",
    };
  } catch {
    return { edge: EDGE_MM, dictionary: "DICT_4X4_50" };
  }
}

function keepMarkers({ edge_mm: edge, dictionary }: Request): void {
  try {
    localStorage.setItem(KEPT, JSON.stringify({ edge, dictionary }));
  } catch {
    // A browser that keeps nothing asks again next time.
  }
}

export function NewAcquisition() {
  const [markers] = useState(lastMarkers);
  const [specimen, setSpecimen] = useState("");
  const [problem, setProblem] = useState<Problem | null>(null);
  const [busy, setBusy] = useState(false);
  // The same press again, after a lost answer, makes no second acquisition.
  const [token, setToken] = useState(() => randomId());

  const submit = async (event: SubmitEvent): Promise<void> => {
    event.preventDefault();
    const given = new FormData(event.currentTarget as HTMLFormElement);
    const text = (name: string): string => {
      const value = given.get(name);
      return typeof value === "string" ? value.trim() : "";
    };
    const request: Request = {
      specimen_id: specimen.trim(),
      accession_number: text("accession") || null,
      dictionary: (text("dictionary") || "DICT_4X4_50") as Dictionary,
      edge_mm: Number(text("edge")),
      notes: text("notes"),
      ...(text("project") ? { project: text("project") } : {}),
    };
    setBusy(true);
    setProblem(null);
    try {
      const params = { header: { "idempotency-key": token } };
      const made = await body(api.POST("/v1/acquisitions", { body: request, params }));
      keepMarkers(request);
      go(["capture", made.id]);
    } catch (thrown) {
      const refused = asProblem(thrown);
      if (refused.status !== 0 && refused.status < 500) setToken(randomId());
      setProblem(refused);
    } finally {
      setBusy(false);
    }
  };

  const projects = session.value?.projects ?? [];
  if (!may("capture.write")) return <p class="page box warning">{t("noUpload")}</p>;
  return (
    <form class="page narrow capture-new" onSubmit={(event) => void submit(event)} data-testid="new-acquisition">
      <h1>{t("new")}</h1>
      <label for="specimen">{t("specimen")}</label>
      <input
        id="specimen"
        data-testid="new-specimen-id"
        value={specimen}
        onInput={(event) => setSpecimen(event.currentTarget.value)}
        pattern={PATTERN}
        title={t("specimenHint")}
        maxLength={64}
        required
        autocomplete="off"
        autocapitalize="characters"
        spellcheck={false}
        aria-describedby="specimen-hint"
      />
      <p id="specimen-hint" class="small">
        {t("specimenHint")}
      </p>
      <Barcode found={setSpecimen} />
      {projects.length > 1 && (
        <>
          <label for="project">{t("project")}</label>
          <select id="project" name="project">
            {projects.map(({ id, name }) => (
              <option value={id}>{name}</option>
            ))}
          </select>
        </>
      )}
      {/* The browser shows what is wrong with a field only where the field is seen. */}
      <details onInvalidCapture={(event) => (event.currentTarget.open = true)}>
        <summary>
          {t("markers")}: {markers.edge} mm, {markers.dictionary}
        </summary>
        <label for="edge">{t("edge")}</label>
        <input id="edge" name="edge" type="number" min="0.5" max="200" step="any" required defaultValue={String(markers.edge)} aria-describedby="edge-hint" />
        <p id="edge-hint" class="small">
          {t("edgeHint")}
        </p>
        <label for="dictionary">{t("dictionary")}</label>
        <select id="dictionary" name="dictionary" defaultValue={markers.dictionary}>
          {DICTIONARIES.map((name) => (
            <option selected={name === markers.dictionary}>{name}</option>
          ))}
        </select>
        <label for="accession">{t("accession")}</label>
        <input id="accession" name="accession" pattern={PATTERN} maxLength={64} autocomplete="off" />
        <label for="notes">{t("notes")}</label>
        <textarea id="notes" name="notes" maxLength={2000} rows={2} />
      </details>
      <button type="submit" class="primary big" disabled={busy} data-testid="create-acquisition">
        {t("create")}
      </button>
      {problem && <ProblemBox problem={problem} />}
    </form>
  );
}
